# The words of the README. `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup build test demo benchmark benchmark-quick faults lint format typecheck config fuzz sigkill audit clean

RECORDING ?=
PYTEST_ARGS ?=
MINUTES ?= 60
BENCHMARK_ARGS ?=
FAULTS ?=
IN_ENV := source env.bash &&

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */  make \1\t/' | expand -t 24

setup:  ## install and build everything; takes seconds when nothing has changed
	@tools/setup.sh

build:  ## build the workspace even if nothing has changed
	@tools/setup.sh --rebuild

test: setup  ## run all tests; PYTEST_ARGS="test/core -k name" runs some
	@$(IN_ENV) python -m pytest $(PYTEST_ARGS)

demo: setup  ## map a simulated room, or RECORDING=path, with the real nodes; results in out/
	@$(IN_ENV) python tools/demo.py $(if $(RECORDING),"$(RECORDING)")

faults: setup  ## inject all faults and write docs/reliability.md; FAULTS="input live" injects some
	@$(IN_ENV) PYTHONPATH="test:$$PYTHONPATH" python -m faults $(FAULTS)

benchmark: setup  ## every recording in MESLAM_DATA x every method: hours, resumable; docs/evaluation.md
	@$(IN_ENV) python benchmarks/evaluation.py $(BENCHMARK_ARGS)

benchmark-quick: setup  ## the same with few frames and one seed: eleven minutes
	@$(IN_ENV) python benchmarks/evaluation.py --quick $(BENCHMARK_ARGS)

lint: setup  ## check style and formatting
	@$(IN_ENV) ruff check . && ruff format --check .

format: setup  ## correct style and formatting
	@$(IN_ENV) ruff check --fix . ; ruff format .

typecheck: setup  ## check the types of the core
	@$(IN_ENV) mypy

fuzz: setup  ## fuzz every parser for MINUTES=60 of processor time; counts add up in docs/reliability
	@$(IN_ENV) python test/fuzz/run.py --minutes $(MINUTES)

sigkill: setup  ## kill whole runs at random instants and load the maps; results in docs/reliability
	@$(IN_ENV) python test/faults/sigkill.py && python test/faults/sigkill_nodes.py

audit:  ## look up known vulnerabilities of all pinned dependencies; needs the network
	@tools/audit.sh

config: setup  ## write the parameter files and their reference from the typed configuration
	@$(IN_ENV) python -m meslam_core.config_reference

clean:  ## remove everything that `make setup` and `make demo` made, but recordings
	rm -rf .venv build install log out
