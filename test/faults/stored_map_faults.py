"""Stored maps that are damaged, or of another version."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

from faults import material
from faults.bench import Bench
from faults.earlier_run import (
    MAP,
    again,
    kept,
    manifest_of,
    mapped,
)
from faults.expectations import (
    BAD_INPUT,
    ended,
    missing,
    refused,
    seen_of,
)
from faults.fault import Group, Seen, faults_of


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
    before = manifest_of(out)
    seen = again(bench, out)
    return Seen(seen.words, {**seen.facts, "earlier": before})


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


_fault = faults_of(Group.STORAGE)

REFUSED_AND_NAMED = "every command says which file is damaged; nothing is made of it"

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


FAULTS = DAMAGED
