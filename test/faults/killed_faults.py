"""Processes that are killed or interrupted."""

from __future__ import annotations

import itertools
import random
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from faults import material
from faults.bench import Bench, wait_for
from faults.earlier_run import (
    SLOW,
    again,
    over_an_earlier_run,
    started,
)
from faults.expectations import (
    INTERRUPTED,
    Problem,
    run,
)
from faults.fault import Group, Seen, faults_of
from faults.material import QUICK

if TYPE_CHECKING:
    from meslam_core.map.stored_region import StoredRegion

FEWEST_STEPS = 5

KILLED_RUNS = 5


def _killed_runs(bench: Bench, out: Path) -> Seen:
    """Killed at random instants of the time that a whole run takes, then once more to the end."""
    from faults.kept_maps import lost_maps

    generator = random.Random(5)
    lost, killed, took_s = [], 0, 0.0

    def watch(process: subprocess.Popen[str]) -> None:
        nonlocal took_s
        started(out, process)
        begun = time.monotonic()
        process.wait()
        took_s = time.monotonic() - begun

    bench.meslam("run", material.bag(bench), "--out", out, *QUICK, during=watch)
    for _ in range(KILLED_RUNS):

        def kill(process: subprocess.Popen[str]) -> None:
            started(out, process)
            time.sleep(generator.uniform(0.0, took_s))
            process.send_signal(signal.SIGKILL)

        done = bench.meslam("run", material.bag(bench), "--out", out, *QUICK, during=kill)
        killed += done.status == -signal.SIGKILL
        lost += lost_maps(out)
    seen = again(bench, out)
    words = f"{killed} of {KILLED_RUNS} runs killed, {len(lost)} maps lost; then {seen.words}"
    return Seen(words, {**seen.facts, "lost": lost, "killed": killed})


def _killed_saves(bench: Bench) -> Seen:
    """A save is killed before its first change of the disk, before its second one, and so on."""
    import pytest
    from data.killed_process import killed_at_call
    from faults.kept_maps import lost_maps

    from meslam_core.map.store import MapStore

    stored = bench.copy(material.stored_map(bench))
    loaded = MapStore(stored).load()
    first = loaded.regions[0]
    lost = []
    for step in itertools.count(1):
        newer = replace(first, version=first.version + step)

        def save(newer: StoredRegion = newer) -> None:
            MapStore(stored).save([newer], loaded.grid)

        status = killed_at_call(step, save, pytest.MonkeyPatch())
        lost += lost_maps(bench.folder)
        if status == 0:
            break
    words = f"killed at {step - 1} steps, {len(lost)} maps lost"
    return Seen(words, {"lost": lost, "killed": step > FEWEST_STEPS})


def _none_lost(seen: Seen) -> str:
    if seen.facts["lost"]:
        return str(seen.facts["lost"][0])
    return "" if seen.facts.get("killed", 1) else "nothing was killed in the middle"


def _interrupted(number: signal.Signals, times: int = 1) -> Callable[[Bench], Seen]:
    def inject(bench: Bench) -> Seen:
        out = bench.folder / "results"

        def interrupt(process: subprocess.Popen[str]) -> None:
            started(out, process)
            # The log of the frames grows line by line, and by blocks on the disk.
            wait_for(lambda: process.poll() is not None or _works(process), "the first frames")
            for _ in range(times):
                process.send_signal(number)
                time.sleep(0.3)

        return run(bench, material.bag(bench), *SLOW, during=interrupt)

    return inject


def _works(process: subprocess.Popen[str]) -> bool:
    """Whether a run has threads that track and map."""
    with open(f"/proc/{process.pid}/status", encoding="ascii") as status:
        return any(line.startswith("Threads:") and int(line.split()[1]) > 2 for line in status)


def _stopped(status: int) -> Problem:
    def problem(seen: Seen) -> str:
        (told,) = seen.facts["ended"]
        if told.status not in (status, 0):
            return f"exit status {told.status} instead of {status}: {told.message}"
        if told.unexplained:
            return str(told.unexplained)
        return "" if seen.facts["report"] else "no results of what was done"

    return problem


def _twice(seen: Seen) -> str:
    """The second request ends it at once, the map is whole or there is none."""
    (told,) = seen.facts["ended"]
    if told.unexplained:
        return str(told.unexplained)
    return "" if told.status in (INTERRUPTED, 0) else f"exit status {told.status}"


_fault = faults_of(Group.STORAGE)

KILLED = (
    _fault(
        "killed-while-saving",
        "SIGKILL before every step of a save that changes the disk, one after the other",
        "every time the map loads",
        _killed_saves,
        _none_lost,
    ),
    _fault(
        "killed-while-running",
        f"{KILLED_RUNS} SIGKILLs at random instants of runs over an earlier map",
        "every time a map loads; the next run works",
        over_an_earlier_run(_killed_runs),
        _none_lost,
        limit_s=240.0,
    ),
    _fault(
        "ctrl-c",
        "CTRL-C in the middle of a run",
        "status 130; the results so far are there, and the map loads",
        _interrupted(signal.SIGINT),
        _stopped(INTERRUPTED),
    ),
    _fault(
        "sigterm",
        "SIGTERM in the middle of a run",
        "status 130; the results so far are there, and the map loads",
        _interrupted(signal.SIGTERM),
        _stopped(INTERRUPTED),
    ),
    _fault(
        "ctrl-c-twice",
        "CTRL-C again and again",
        "it ends at once; no half map is left",
        _interrupted(signal.SIGINT, 3),
        _twice,
    ),
)


FAULTS = KILLED
