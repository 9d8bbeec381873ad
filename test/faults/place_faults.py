"""Places that results cannot be written to, and two who want the same one."""

from __future__ import annotations

import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from faults import material
from faults.bench import MESLAM, Bench
from faults.earlier_run import (
    MAP,
    SLOW,
    again,
    kept,
    manifest_of,
    over_an_earlier_run,
    started,
)
from faults.expectations import (
    BAD_INPUT,
    Problem,
    ended,
    refused,
    run,
    seen_of,
    tracked,
)
from faults.fault import Group, Seen, faults_of
from faults.material import FRAMES, QUICK
from faults.places import become_nobody, fill, read_only, small_disk


def _disk_full(left_kb: int) -> Callable[[Bench], Seen]:
    def inject(bench: Bench) -> Seen:
        with small_disk(bench.folder / "disk", 400) as disk:
            out = Path(shutil.copytree(material.stored_map(bench).parent, disk / "results"))
            earlier = manifest_of(out)
            fill(disk, left_kb)
            seen = again(bench, out)
            kept_here = manifest_of(out)
            # The disk is gone when the harness looks for lost maps.
            shutil.copytree(out / MAP, bench.folder / MAP)
            left = [file.name for file in out.iterdir() if file.name.startswith(".")]
        return Seen(
            seen.words, {**seen.facts, "earlier": earlier, "manifest": kept_here, "left": left}
        )

    return inject


def _nothing_left(then: Problem) -> Problem:
    def problem(seen: Seen) -> str:
        left = seen.facts["left"]
        return then(seen) or (f"{', '.join(left)} left behind" if left else "")

    return problem


def _read_only(bench: Bench, out: Path) -> Seen:
    with read_only(out):
        return again(bench, out)


def _not_permitted(bench: Bench) -> Seen:
    become = become_nobody()
    # Others may not enter a temporary folder either.
    out = bench.folder / "results"
    out.mkdir(mode=0o755)
    return again(bench, out, before=become)


def _map_not_readable(bench: Bench) -> Seen:
    become = become_nobody()
    stored = bench.copy(material.stored_map(bench))
    for file in stored.iterdir():
        file.chmod(0o600)
    return seen_of(bench, bench.meslam("info", stored, before=become))


def _out_is_a_file(bench: Bench) -> Seen:
    (bench.folder / "results").write_text("mine")
    seen = run(bench, material.bag(bench))
    return Seen(seen.words, {**seen.facts, "report": {}})


def _out_has_a_long_name(bench: Bench) -> Seen:
    return again(bench, bench.folder / ("long" * 100))


def _out_vanishes(bench: Bench) -> Seen:
    out = bench.folder / "results"

    def remove(process: subprocess.Popen[str]) -> None:
        started(out, process)
        shutil.rmtree(out, ignore_errors=True)

    return run(bench, material.bag(bench), *SLOW, during=remove)


def _two_systems(bench: Bench) -> Seen:
    out = bench.folder / "results"
    process = subprocess.Popen(
        [*MESLAM, *map(str, ("run", material.bag(bench), "--out", out, *QUICK, *SLOW))],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        started(out, process)
        # However long the second one takes to start, the first one is still at work.
        process.send_signal(signal.SIGSTOP)
        second = bench.meslam("run", material.bag(bench), "--out", out, *QUICK)
        process.send_signal(signal.SIGCONT)
        first_status = process.wait()
    finally:
        process.kill()
    seen = seen_of(bench, second)
    return Seen(seen.words, {**seen.facts, "holder": process.pid, "first": first_status})


def _told_who(seen: Seen) -> str:
    if seen.facts["first"] != 0:
        return f"the first run ended with {seen.facts['first']}"
    return refused("being written by", f"process {seen.facts['holder']}")(seen)


def _stale_lock(bench: Bench) -> Seen:
    out = bench.folder / "results"

    def kill(process: subprocess.Popen[str]) -> None:
        started(out, process)
        process.send_signal(signal.SIGKILL)

    again(bench, out, during=kill)
    seen = again(bench, out)
    left = [file.name for file in out.iterdir() if file.name.startswith(".")]
    return Seen(seen.words, {**seen.facts, "left": left})


_fault = faults_of(Group.STORAGE)

PLACES = (
    _fault(
        "disk-full-in-the-save",
        "the disk has room for 32 kB when a run wants to write results and a map of 48 kB",
        "status 2 names the folder; the earlier results are untouched, nothing is left behind",
        _disk_full(32),
        _nothing_left(kept(ended("No space left", status=BAD_INPUT))),
    ),
    _fault(
        "disk-full-at-the-start",
        "the disk is full when a run starts",
        "status 2 names the folder; the earlier results are untouched",
        _disk_full(0),
        _nothing_left(kept(ended("No space left", status=BAD_INPUT))),
    ),
    _fault(
        "folder-read-only",
        "the folder of the results is mounted read-only",
        "refused before the first frame; the earlier results are untouched",
        over_an_earlier_run(_read_only),
        kept(ended("cannot be written", "Read-only", status=BAD_INPUT)),
    ),
    _fault(
        "folder-not-permitted",
        "the folder of the results belongs to somebody else",
        "refused before the first frame; the folder is named",
        _not_permitted,
        refused("cannot be"),
    ),
    _fault(
        "map-not-permitted",
        "a stored map's files may not be read",
        "refused; the file is named",
        _map_not_readable,
        refused("ermission denied"),
    ),
    _fault(
        "folder-is-a-file",
        "the folder of the results is a file",
        "refused before the first frame",
        _out_is_a_file,
        refused("cannot be written"),
        quick=True,
    ),
    _fault(
        "folder-name-too-long",
        "the name of the results' folder is longer than names may be",
        "refused before the first frame",
        _out_has_a_long_name,
        refused("cannot be"),
    ),
    _fault(
        "folder-vanishes",
        "the folder of the results is removed while the run goes on",
        "it is made again; trajectory, map and report are there",
        _out_vanishes,
        tracked(FRAMES),
    ),
    _fault(
        "two-systems-one-folder",
        "a second run is started into the folder of one that still goes on",
        "the second is told which process writes there; the first is not disturbed",
        _two_systems,
        _told_who,
    ),
    _fault(
        "lock-of-a-killed-run",
        "a run into a folder was killed; the next one follows",
        "it is not locked out, and clears away what the killed one left",
        _stale_lock,
        _nothing_left(ended()),
    ),
)


FAULTS = PLACES
