"""A run into a folder that holds the results of an earlier one."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults import material
from faults.bench import Bench, wait_for
from faults.expectations import Problem, report_in, seen_of
from faults.fault import Seen
from faults.material import QUICK

MAP = "map.meslam"
SLOW = ("--set", "mapping.iterations=60")


def mapped(bench: Bench, name: str = "results") -> Path:
    """A folder with the results of an earlier run."""
    return bench.copy(material.stored_map(bench).parent, name)


def again(bench: Bench, out: Path, *options: object, **how: Any) -> Seen:
    """Run the walk once more into a folder."""
    done = bench.meslam("run", material.bag(bench), "--out", out, *QUICK, *options, **how)
    # Where it failed, the report is the earlier run's.
    report = report_in(out) if done.status == 0 else {}
    return seen_of(bench, done, report=report, manifest=manifest_of(out))


def started(out: Path, process: subprocess.Popen[str]) -> None:
    """Wait until a run has begun to work."""
    wait_for(lambda: process.poll() is not None or any(out.glob(".incomplete*")), "a start")


def over_an_earlier_run(
    spoil: Callable[[Bench, Path], Seen],
) -> Callable[[Bench], Seen]:
    """Something happens to a folder with the results of an earlier run."""

    def inject(bench: Bench) -> Seen:
        out = mapped(bench)
        earlier = manifest_of(out)
        seen = spoil(bench, out)
        return Seen(seen.words, {**seen.facts, "earlier": earlier, "manifest": manifest_of(out)})

    return inject


def kept(then: Problem) -> Problem:
    """The map of the earlier run is still there, and something else holds."""

    def problem(seen: Seen) -> str:
        if seen.facts["manifest"] != seen.facts["earlier"]:
            return "the earlier map was changed"
        return then(seen)

    return problem


def manifest_of(out: Path) -> bytes:
    """A run's manifest; empty where there is none."""
    try:
        return (out / MAP / "manifest.json").read_bytes()
    except OSError:
        return b""
