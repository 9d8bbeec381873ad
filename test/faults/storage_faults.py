"""Faults of the place that results and maps are written to, and of maps that lie there."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from faults import material
from faults.bench import MESLAM, Bench, wait_for
from faults.expectations import (
    BAD_INPUT,
    INTERRUPTED,
    Problem,
    ended,
    missing,
    refused,
    report_in,
    run,
    seen_of,
    tracked,
)
from faults.fault import Fault, Group, Seen
from faults.material import FRAMES, QUICK
from faults.places import become_nobody, fill, read_only, small_disk

MAP = "map.meslam"
KILLED_SAVES = 12
KILLED_RUNS = 5
SLOW = ("--set", "mapping.iterations=60")


def mapped(bench: Bench, name: str = "results") -> Path:
    """A folder with the results of an earlier run."""
    return bench.copy(material.stored_map(bench).parent, name)


def again(bench: Bench, out: Path, *options: object, **how: object) -> Seen:
    """Run the walk once more into a folder."""
    done = bench.meslam("run", material.bag(bench), "--out", out, *QUICK, *options, **how)
    return seen_of(bench, done, report=report_in(out), manifest=_manifest(out))


def kept(then: Problem) -> Problem:
    """The map of the earlier run is still there, and something else holds."""

    def problem(seen: Seen) -> str:
        if seen.facts["manifest"] != seen.facts["earlier"]:
            return "the earlier map was changed"
        return then(seen)

    return problem


def over_an_earlier_run(
    spoil: Callable[[Bench, Path], Seen],
) -> Callable[[Bench], Seen]:
    """Something happens to a folder with the results of an earlier run."""

    def inject(bench: Bench) -> Seen:
        out = mapped(bench)
        earlier = _manifest(out)
        seen = spoil(bench, out)
        return Seen(seen.words, {**seen.facts, "earlier": earlier, "manifest": _manifest(out)})

    return inject


def started(out: Path, process: subprocess.Popen[str]) -> None:
    """Wait until a run has begun to work."""
    wait_for(lambda: process.poll() is not None or any(out.glob(".incomplete*")), "a start")


def _manifest(out: Path) -> bytes:
    file = out / MAP / "manifest.json"
    return file.read_bytes() if file.exists() else b""


def _disk_full(left_kb: int) -> Callable[[Bench], Seen]:
    def inject(bench: Bench) -> Seen:
        with small_disk(bench.folder / "disk", 400) as disk:
            out = Path(shutil.copytree(material.stored_map(bench).parent, disk / "results"))
            earlier = _manifest(out)
            fill(disk, left_kb)
            seen = again(bench, out)
            kept_here = _manifest(out)
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


def _newer(bench: Bench) -> Path:
    from data.stored_maps import resealed

    stored = bench.copy(material.stored_map(bench))
    manifest = stored / "manifest.json"
    manifest.write_bytes(resealed(json.loads(manifest.read_bytes()) | {"version": 99}))
    return stored


def _newer_read(bench: Bench) -> Seen:
    stored = _newer(bench)
    points = ("--map", stored, "--start-pose", "0 0 0 0 0 0 1")
    return seen_of(
        bench,
        bench.meslam("info", stored),
        bench.meslam("mesh", stored, "--out", bench.folder / "room.ply"),
        bench.meslam("run", material.bag(bench), "--out", bench.folder / "out", *points),
    )


def _newer_replaced(bench: Bench) -> Seen:
    out = bench.folder / "results"
    out.mkdir()
    _newer(bench).rename(out / MAP)
    before = _manifest(out)
    seen = again(bench, out)
    return Seen(seen.words, {**seen.facts, "earlier": before})


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
        second = bench.meslam("run", material.bag(bench), "--out", out, *QUICK)
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


def _killed_runs(bench: Bench, out: Path) -> Seen:
    """Killed at random instants, then once more to the end."""
    from faults.kept_maps import lost_maps

    generator = random.Random(5)
    lost, killed = [], 0
    for _ in range(KILLED_RUNS):

        def kill(process: subprocess.Popen[str]) -> None:
            started(out, process)
            time.sleep(generator.uniform(0.0, 3.0))
            process.send_signal(signal.SIGKILL)

        done = bench.meslam("run", material.bag(bench), "--out", out, *QUICK, during=kill)
        killed += done.status == -signal.SIGKILL
        lost += lost_maps(out)
    seen = again(bench, out)
    words = f"{killed} of {KILLED_RUNS} runs killed, {len(lost)} maps lost; then {seen.words}"
    return Seen(words, {**seen.facts, "lost": lost, "killed": killed})


def _killed_saves(bench: Bench) -> Seen:
    """A process that saves two maps in turn is killed; one of them is there, whole."""
    from faults.kept_maps import lost_maps

    stored = bench.copy(material.stored_map(bench))
    generator = random.Random(7)
    lost = []
    saving = (
        "import sys, itertools; from pathlib import Path\n"
        "from meslam_core.map.store import MapStore\n"
        "from dataclasses import replace\n"
        "store = MapStore(sys.argv[1]); loaded = store.load(); first = loaded.regions[0]\n"
        "print('saving', flush=True)\n"
        "for version in itertools.count(first.version + 1):\n"
        "    store.save([replace(first, version=version)], loaded.grid)\n"
    )
    for _ in range(KILLED_SAVES):
        process = subprocess.Popen(
            [MESLAM[0], "-c", saving, str(stored)], stdout=subprocess.PIPE, text=True
        )
        try:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(generator.uniform(0.0, 0.2))
        finally:
            process.kill()
            process.communicate()
        lost += lost_maps(bench.folder)
    return Seen(f"{KILLED_SAVES} saves killed, {len(lost)} maps lost", {"lost": lost})


def _none_lost(seen: Seen) -> str:
    if seen.facts["lost"]:
        return str(seen.facts["lost"][0])
    return "" if seen.facts.get("killed", 1) else "no run was killed in time"


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
    """The second request ends it at once: a map or none, and nothing half."""
    (told,) = seen.facts["ended"]
    expected = (INTERRUPTED, -signal.SIGINT, 1, 0)
    return "" if told.status in expected else f"exit status {told.status}"


def _disappearing_map(bench: Bench) -> Seen:
    """The earlier results' folder is empty but for a map that somebody took away half."""
    out = mapped(bench)
    next((out / MAP).glob("region_*")).unlink()
    return seen_of(bench, bench.meslam("info", out / MAP))


def _damage(change: Callable[[Path], object]) -> Callable[[Bench], Seen]:
    """Damage a stored map, then use it in every way."""

    def inject(bench: Bench) -> Seen:
        stored = bench.copy(material.stored_map(bench), "harmed.meslam")
        change(stored)
        start = ("--map", stored, "--start-pose", "0 0 0 -0.5 0.5 -0.5 0.5")
        return seen_of(
            bench,
            bench.meslam("info", stored),
            bench.meslam("mesh", stored, "--out", "room.ply", "--resolution", "0.05"),
            bench.meslam("run", material.bag(bench), "--out", "out", *start),
        )

    return inject


def _cut_region(stored: Path) -> None:
    region = next(stored.glob("region_*"))
    region.write_bytes(region.read_bytes()[:-100])


def _flip_region(stored: Path) -> None:
    region = next(stored.glob("region_*"))
    data = bytearray(region.read_bytes())
    data[len(data) // 2] ^= 4
    region.write_bytes(data)


def _swap_for_folder(stored: Path) -> None:
    region = next(stored.glob("region_*"))
    region.unlink()
    region.mkdir()


def _swap_for_device(stored: Path) -> None:
    region = next(stored.glob("region_*"))
    region.unlink()
    region.symlink_to("/dev/zero")


def _swap_for_pipe(stored: Path) -> None:
    region = next(stored.glob("region_*"))
    region.unlink()
    os.mkfifo(region)


def _garble_manifest(stored: Path) -> None:
    (stored / "manifest.json").write_bytes(b'{"format": "mes')


def _rebuilt(seen: Seen) -> str:
    """The map is put together from its regions; it is used, but not gone on with."""
    info, mesh, continued = seen.facts["ended"]
    for each in (info, mesh, continued):
        if each.unexplained or each.status != BAD_INPUT:
            return each.unexplained or f"exit status {each.status}"
        if told := missing(each.stderr, ("manifest.json",)):
            return told
    return missing(info.stderr + mesh.stderr, ("rest of the map was used",))


def _fault(
    name: str,
    injected: str,
    expected: str,
    inject: Callable[[Bench], Seen],
    problem: Problem,
    quick: bool = False,
    harmed: tuple[str, ...] = (),
    limit_s: float = 120.0,
) -> Fault:
    return Fault(
        name, Group.STORAGE, injected, expected, inject, problem, limit_s, quick, harmed=harmed
    )


REFUSED_AND_NAMED = "every command says which file is damaged; nothing is made of it"
PLACES = (
    _fault(
        "disk-full-in-the-save",
        "the disk has room for 12 kB when a run wants to replace a map of 24 kB",
        "status 2 names the folder; the earlier results are untouched, nothing is left behind",
        _disk_full(12),
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
KILLED = (
    _fault(
        "killed-while-saving",
        f"{KILLED_SAVES} SIGKILLs at random instants of a save",
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
DAMAGED = (
    _fault(
        "map-of-a-newer-version",
        "a stored map says that a newer version wrote it",
        "info, mesh and run --map refuse it in words",
        _newer_read,
        refused("newer"),
        harmed=(MAP,),
    ),
    _fault(
        "map-of-a-newer-version-in-the-way",
        "a run's folder holds a map of a newer version",
        "refused before the first frame; the map is not overwritten",
        _newer_replaced,
        kept(ended("newer", "not overwritten", status=BAD_INPUT)),
        harmed=(MAP,),
    ),
    _fault(
        "manifest-damaged",
        "half of a map's manifest is missing",
        "the map is put together from its regions, and that is told with status 2",
        _damage(_garble_manifest),
        _rebuilt,
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-truncated",
        "a region's file has lost its last 100 bytes",
        REFUSED_AND_NAMED,
        _damage(_cut_region),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-flipped",
        "one bit of a region's file is wrong",
        REFUSED_AND_NAMED,
        _damage(_flip_region),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-missing",
        "a region's file is not there",
        "the file is named with status 2",
        _disappearing_map,
        refused("region_0_0_0"),
        harmed=(MAP,),
    ),
    _fault(
        "region-is-a-folder",
        "in the place of a region's file is a folder",
        REFUSED_AND_NAMED,
        _damage(_swap_for_folder),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-is-a-device",
        "a region's file is a link to /dev/zero, which never ends",
        REFUSED_AND_NAMED,
        _damage(_swap_for_device),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
    _fault(
        "region-is-a-pipe",
        "in the place of a region's file is a named pipe that nobody writes",
        REFUSED_AND_NAMED,
        _damage(_swap_for_pipe),
        refused("region_0_0_0"),
        harmed=("harmed.meslam",),
    ),
)
FAULTS = PLACES + KILLED + DAMAGED
