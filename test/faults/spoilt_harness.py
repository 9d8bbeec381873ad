"""Faults that a broken system would show: the harness must notice each of them."""

from __future__ import annotations

import os
import signal
import subprocess
import time

from faults.bench import Bench
from faults.fault import Fault, Group, Seen, SkippedError


def _hang(bench: Bench) -> Seen:
    # A grandchild as well: nothing may outlive its fault.
    subprocess.Popen(["sleep", "600"])
    time.sleep(600)
    return Seen("never")


def _crash(bench: Bench) -> Seen:
    os.kill(os.getpid(), signal.SIGSEGV)
    return Seen("never")


def _exit(bench: Bench) -> Seen:
    os._exit(5)


def _raise(bench: Bench) -> Seen:
    raise KeyError("depth")


def _lose_map(bench: Bench) -> Seen:
    stored = bench.folder / "room.meslam"
    stored.mkdir()
    (stored / "manifest.json").write_text("{")
    return Seen("all is well")


def _skip(bench: Bench) -> Seen:
    raise SkippedError("this machine has no moon")


def _fault(name, inject, problem=lambda seen: "", **options) -> Fault:
    return Fault(name, Group.LOAD, f"{name} is injected", "nothing", inject, problem, **options)


FAULTS = (
    _fault("hang", _hang, limit_s=0.5),
    _fault("crash", _crash),
    _fault("exit", _exit),
    _fault("raise", _raise),
    _fault("lost-map", _lose_map),
    _fault("harmed-map", _lose_map, harmed=("room.meslam",)),
    _fault("miss", lambda bench: Seen("a cat"), lambda seen: f"{seen.words} instead of a dog"),
    _fault("skip", _skip),
    _fault("fine", lambda bench: Seen("a dog")),
)
