from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import random
import resource
import shutil
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.analytic_scene import GRID

from meslam_core.errors import MapError, OutputError
from meslam_core.map import codec
from meslam_core.map.manifest import Manifest
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid

Regions = list[StoredRegion]


@pytest.fixture
def saved(tmp_path: Path, two_small_regions: Regions) -> MapStore:
    """A map of two regions."""
    store = MapStore(tmp_path / "flat.meslam")
    store.save(two_small_regions, GRID)
    return store


def changed(region: StoredRegion) -> StoredRegion:
    parameters = region.parameters + np.float32(0.25)
    return replace(region, parameters=parameters, version=region.version + 1)


def region_files(store: MapStore) -> list[Path]:
    return sorted(store.path.glob("region_*.msr"))


def versions(store: MapStore) -> dict[tuple[int, int, int], int]:
    loaded = store.load()
    assert not loaded.warnings
    return {region.index: region.version for region in loaded.regions}


def test_a_map_comes_back_as_it_was_saved(tmp_path: Path, two_small_regions: Regions) -> None:
    store = MapStore(tmp_path / "deep" / "flat.meslam")
    nodes = [{"region": [0, 0, 0], "T": [1.5, 2.0]}]
    map_id = store.save(two_small_regions, GRID, precision="fp32", nodes=nodes)
    loaded = MapStore(store.path).load()
    assert loaded.map_id == map_id
    assert loaded.warnings == []
    assert list(loaded.nodes) == nodes
    assert np.array_equal(loaded.grid.origin, GRID.origin)
    assert (loaded.grid.side_m, loaded.grid.overlap) == (GRID.side_m, GRID.overlap)
    for back, original in zip(loaded.regions, two_small_regions, strict=True):
        assert np.array_equal(back.parameters, original.parameters)
        assert np.array_equal(back.mask.flags, original.mask.flags)
    on_disk = sum(file.stat().st_size for file in store.path.iterdir())
    assert store.map_bytes == on_disk


def test_an_empty_map(tmp_path: Path) -> None:
    store = MapStore(tmp_path / "empty.meslam")
    store.save([], GRID)
    assert store.load().regions == []


def test_only_changed_regions_are_written(saved: MapStore, two_small_regions: Regions) -> None:
    before = {file.name: file.stat().st_ino for file in region_files(saved)}
    map_id = saved.load().map_id
    for store in (saved, MapStore(saved.path)):
        assert store.save(two_small_regions, GRID) == map_id
        assert {file.name: file.stat().st_ino for file in region_files(saved)} == before
    two_small_regions[1] = changed(two_small_regions[1])
    saved.save(two_small_regions, GRID)
    after = {file.name: file.stat().st_ino for file in region_files(saved)}
    kept = before.keys() & after.keys()
    assert len(after) == 2
    assert len(kept) == 1
    assert all(before[name] == after[name] for name in kept)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 5}


def test_encoded_regions_are_stored_as_they_are(
    saved: MapStore, two_small_regions: Regions
) -> None:
    data = codec.encode(changed(two_small_regions[0]), "fp16")
    saved.save([data, two_small_regions[1]], GRID)
    assert data in [file.read_bytes() for file in region_files(saved)]
    with pytest.raises(MapError, match="truncated"):
        saved.save([data[:10]], GRID)
    assert versions(saved) == {(0, 0, 0): 5, (1, 0, 0): 4}


def test_regions_no_longer_in_the_map_are_removed(
    saved: MapStore, two_small_regions: Regions
) -> None:
    saved.save(two_small_regions[:1], GRID)
    assert len(region_files(saved)) == 1


def test_two_regions_at_one_place(saved: MapStore, two_small_regions: Regions) -> None:
    with pytest.raises(MapError, match="the place"):
        saved.save([two_small_regions[0], changed(two_small_regions[0])], GRID)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 4}


def test_what_a_crash_left_is_cleared_by_the_next_save(
    saved: MapStore, two_small_regions: Regions
) -> None:
    orphan = saved.path / "region_5_5_5.0123456789abcdef.msr"
    orphan.write_bytes(b"half a reg")
    (saved.path / "manifest.json.tmp").write_bytes(b"{")
    assert versions(saved)
    saved.save(two_small_regions, GRID)
    assert sorted(file.name for file in saved.path.iterdir()) == sorted(
        ["manifest.json", *(file.name for file in region_files(saved))]
    )
    assert not orphan.exists()


@contextlib.contextmanager
def failing(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[list[str]]:
    """The `number`-th call to the operating system that changes the disk fails."""
    calls: list[str] = []

    def fragile(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            calls.append(name)
            if len(calls) == number:
                raise OSError(errno.ENOSPC, "No space left on device")
            return original(*arguments, **named)

        return call

    with monkeypatch.context() as patch:
        for name in ("fsync", "replace", "unlink", "open", "mkdir"):
            patch.setattr(os, name, fragile(name, getattr(os, name)))
        yield calls


def test_a_failure_at_any_step_leaves_the_old_map_or_the_new(
    tmp_path: Path, two_small_regions: Regions, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = [changed(region) for region in two_small_regions]
    outcomes = set()
    for number in range(1, 100):
        store = MapStore(tmp_path / f"{number}.meslam")
        store.save(two_small_regions, GRID)
        with failing(monkeypatch, number) as calls:
            message = ""
            try:
                store.save(new, GRID)
            except OutputError as error:
                message = str(error)
        assert not message or str(store.path) in message
        found = versions(store)
        assert found in ({(0, 0, 0): 4, (1, 0, 0): 4}, {(0, 0, 0): 5, (1, 0, 0): 5})
        assert not list(store.path.glob("*.tmp"))
        outcomes.add((bool(message), found[(0, 0, 0)]))
        store.save(new, GRID)
        assert versions(store) == {(0, 0, 0): 5, (1, 0, 0): 5}
        assert len(list(store.path.iterdir())) == 3
        if len(calls) < number:
            break
    assert number > 10
    assert {(True, 4), (False, 5)} <= outcomes


def test_a_failed_first_save_leaves_nothing_behind(
    tmp_path: Path, two_small_regions: Regions, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(1, 100):
        store = MapStore(tmp_path / f"{number}.meslam")
        with failing(monkeypatch, number) as calls:
            try:
                store.save(two_small_regions, GRID)
            except OutputError:
                if store.path.exists():
                    assert versions(store) == {(0, 0, 0): 4, (1, 0, 0): 4}
        if len(calls) < number:
            break
    assert number > 8


@contextlib.contextmanager
def child(work: Callable[[], None]) -> Iterator[int]:
    """A process of its own that works until it is killed, at the latest on leaving."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads
        process = os.fork()
    if process == 0:
        try:
            work()
        finally:
            os._exit(1)
    try:
        yield process
    finally:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)


def status_of(work: Callable[[], None]) -> int:
    """With what a process of its own ends, or the signal that ended it."""
    with child(work) as process:
        return os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT).si_status


def contents(store: MapStore) -> set[bytes]:
    """The encoded regions of an undamaged map."""
    loaded = store.load()
    assert not loaded.warnings
    return set(loaded.encoded.values())


@pytest.fixture
def two_maps(two_small_regions: Regions) -> list[list[bytes]]:
    """Two maps of the same places with nothing in common."""
    return [
        [codec.encode(region) for region in regions]
        for regions in (two_small_regions, [changed(region) for region in two_small_regions])
    ]


def test_killed_at_random_instants_while_saving(
    saved: MapStore, two_maps: list[list[bytes]]
) -> None:
    """A child saves two maps in turn and is killed; what is there is always one of them."""

    def save_for_ever() -> None:
        while True:
            for regions in reversed(two_maps):
                MapStore(saved.path).save(regions, GRID)

    generator = random.Random(1)
    seen, halfway = [], 0
    for _ in range(50):
        with child(save_for_ever):
            time.sleep(generator.uniform(0.0, 0.03))
        halfway += len(os.listdir(saved.path)) != 3
        seen.append(contents(saved))
    assert all(found in (set(two_maps[0]), set(two_maps[1])) for found in seen)
    assert halfway > 5, "hardly any kill came in the middle of a save"
    saved.save(two_maps[0], GRID)
    assert len(list(saved.path.iterdir())) == 3


def test_killed_at_every_step_of_a_save(
    saved: MapStore, two_maps: list[list[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As above, with the kill before each call that changes the disk, one after the other."""
    found = []
    for number in range(1, 100):
        saved.save(two_maps[0], GRID)

        def save_and_die(number: int = number) -> None:
            calls = iter(range(1, 1000))

            def fatal(original: Callable[..., Any]) -> Callable[..., Any]:
                def call(*arguments: Any, **named: Any) -> Any:
                    if next(calls) == number:
                        os.kill(os.getpid(), signal.SIGKILL)
                    return original(*arguments, **named)

                return call

            for name in ("fsync", "replace", "unlink"):
                monkeypatch.setattr(os, name, fatal(getattr(os, name)))
            MapStore(saved.path).save(two_maps[1], GRID)
            os._exit(0)

        status = status_of(save_and_die)
        found.append([set(regions) for regions in two_maps].index(contents(saved)))
        if status == 0:
            break
    assert len(found) > 10
    assert found == sorted(found), "the new map was there, and then not"
    assert {found[0], found[-1]} == {0, 1}


def test_reading_while_another_process_saves(saved: MapStore, two_maps: list[list[bytes]]) -> None:
    def save_for_ever() -> None:
        while True:
            for regions in reversed(two_maps):
                MapStore(saved.path).save(regions, GRID)
                time.sleep(0.002)

    with child(save_for_ever):
        found = [contents(saved) for _ in range(150)]
    assert all(each in (set(two_maps[0]), set(two_maps[1])) for each in found)
    assert len({frozenset(each) for each in found}) == 2


def test_a_full_disk_leaves_the_old_map(saved: MapStore, two_maps: list[list[bytes]]) -> None:
    """The limit on a file's size stands for the disk's end: writing fails half-way."""

    def save_on_a_full_disk() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))
        try:
            MapStore(saved.path).save(two_maps[1], GRID)
        except OutputError as error:
            os._exit(7 if "cannot be written" in str(error) else 8)

    assert status_of(save_on_a_full_disk) == 7
    assert contents(saved) == set(two_maps[0])
    assert len(os.listdir(saved.path)) == 3
    saved.save(two_maps[1], GRID)
    assert contents(saved) == set(two_maps[1])


def test_a_folder_without_permission(two_maps: list[list[bytes]]) -> None:
    def save_as_somebody_else() -> None:
        if os.getuid() == 0:
            os.setuid(65534)
        try:
            MapStore(path).save(two_maps[1], GRID)
        except OutputError as error:
            os._exit(7 if str(path) in str(error) else 8)

    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        path = Path(folder, "flat.meslam")
        MapStore(path).save(two_maps[0], GRID)
        os.chmod(path, 0o555)
        assert status_of(save_as_somebody_else) == 7
        assert contents(MapStore(path)) == set(two_maps[0])
        os.chmod(path, 0o755)


def test_a_vanished_folder_is_made_again(saved: MapStore, two_small_regions: Regions) -> None:
    shutil.rmtree(saved.path.parent)
    saved.save(two_small_regions, GRID)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 4}


def test_a_changed_byte_in_a_region_is_named_and_the_rest_loads(saved: MapStore) -> None:
    for damaged, other in zip(region_files(saved), ((1, 0, 0), (0, 0, 0)), strict=True):
        data = damaged.read_bytes()
        for position in [*range(64), *range(64, len(data), 7)]:
            flipped = data[position] ^ (1 << position % 8)
            damaged.write_bytes(data[:position] + bytes([flipped]) + data[position + 1 :])
            loaded = saved.load()
            assert [region.index for region in loaded.regions] == [other]
            assert len(loaded.warnings) == 1
            assert damaged.name in loaded.warnings[0]
        damaged.write_bytes(data)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 4}


def test_a_changed_byte_in_any_file_of_a_large_map_is_named(
    tmp_path: Path, region: StoredRegion, neighbour: StoredRegion
) -> None:
    store = MapStore(tmp_path / "room.meslam")
    store.save([region, neighbour], GRID)
    generator = random.Random(2)
    for damaged in sorted(store.path.iterdir()):
        data = damaged.read_bytes()
        for position in (0, len(data) - 1, *generator.sample(range(len(data)), 8)):
            flipped = data[position] ^ (1 << generator.randrange(8))
            damaged.write_bytes(data[:position] + bytes([flipped]) + data[position + 1 :])
            loaded = store.load()
            assert damaged.name in loaded.warnings[0]
            assert len(loaded.regions) == (2 if damaged.name == "manifest.json" else 1)
        damaged.write_bytes(data)


def test_a_missing_region_is_named_and_the_rest_loads(saved: MapStore) -> None:
    missing = region_files(saved)[0]
    missing.unlink()
    loaded = saved.load()
    assert [region.index for region in loaded.regions] == [(1, 0, 0)]
    assert missing.name in loaded.warnings[0]


def test_two_region_files_exchanged(saved: MapStore) -> None:
    first, second = region_files(saved)
    a, b = first.read_bytes(), second.read_bytes()
    first.write_bytes(b)
    second.write_bytes(a)
    with pytest.raises(MapError, match="no region can be read"):
        saved.load()


def test_a_changed_byte_in_the_manifest_is_noticed_and_the_map_rebuilt(saved: MapStore) -> None:
    path = saved.path / "manifest.json"
    data = path.read_bytes()
    for position in range(len(data)):
        path.write_bytes(data[:position] + bytes([data[position] ^ 0x04]) + data[position + 1 :])
        loaded = saved.load()
        assert "manifest.json" in loaded.warnings[0]
        assert len(loaded.regions) == 2
        assert np.allclose(loaded.grid.origin, GRID.origin)
        assert loaded.grid.overlap == pytest.approx(GRID.overlap)
    with pytest.raises(MapError, match="checksum"):
        saved.manifest()


@pytest.mark.parametrize("content", [b"", b"{}", b"\0" * 100, b"[" * 100_000])
def test_a_destroyed_manifest_is_rebuilt(saved: MapStore, content: bytes) -> None:
    (saved.path / "manifest.json").write_bytes(content)
    assert len(saved.load().regions) == 2


def test_rebuilding_takes_the_newest_region_of_a_place(
    saved: MapStore, two_small_regions: Regions
) -> None:
    newer = codec.encode(changed(two_small_regions[0]))
    (saved.path / "region_0_0_0.0123456789abcdef.msr").write_bytes(newer)
    (saved.path / "region_9_9_9.0123456789abcdef.msr").write_bytes(newer[:50])
    (saved.path / "manifest.json").write_bytes(b"?")
    loaded = saved.load()
    assert {r.index: r.version for r in loaded.regions} == {(0, 0, 0): 5, (1, 0, 0): 4}
    assert any("region_9_9_9" in warning for warning in loaded.warnings)


def test_a_missing_manifest(saved: MapStore) -> None:
    (saved.path / "manifest.json").unlink()
    with pytest.raises(MapError, match="recovery"):
        saved.load()
    assert len(saved.load(recover=True).regions) == 2


def test_no_map_there(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="does not exist"):
        MapStore(tmp_path / "nowhere").load()
    with pytest.raises(MapError, match="no map"):
        MapStore(tmp_path).load()
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(MapError, match="no folder"):
        MapStore(tmp_path / "file").load()


def resealed(document: dict[str, Any]) -> bytes:
    """A manifest of any content with a checksum that is right."""
    import hashlib

    document["sha256"] = "0" * 64
    blank = json.dumps(document, indent=1).encode() + b"\n"
    return blank.replace(b"0" * 64, hashlib.sha256(blank).hexdigest().encode())


def test_a_newer_map_is_refused_and_not_overwritten(
    saved: MapStore, two_small_regions: Regions
) -> None:
    path = saved.path / "manifest.json"
    newer = resealed(json.loads(path.read_bytes()) | {"version": 2})
    path.write_bytes(newer)
    with pytest.raises(MapError, match="newer MeSLAM"):
        saved.load()
    with pytest.raises(OutputError, match="not overwritten"):
        saved.save(two_small_regions, GRID)
    assert path.read_bytes() == newer


@pytest.mark.parametrize(
    "change",
    [
        {"file": "../../secret.msr"},
        {"file": "/etc/passwd"},
        {"index": [0, 0]},
        {"bytes": "many"},
    ],
)
def test_a_manifest_cannot_name_other_files(saved: MapStore, change: dict[str, Any]) -> None:
    document = json.loads((saved.path / "manifest.json").read_bytes())
    document["regions"][0] |= change
    with pytest.raises(MapError, match="malformed"):
        Manifest.from_bytes(resealed(document), "manifest.json")


def test_a_manifest_reads_back(saved: MapStore) -> None:
    data = (saved.path / "manifest.json").read_bytes()
    assert Manifest.from_bytes(data, "manifest.json").to_bytes() == data


def test_damaged_files_are_set_aside_by_the_next_save(
    saved: MapStore, two_small_regions: Regions
) -> None:
    damaged = region_files(saved)[0]
    damaged.write_bytes(b"damaged")
    saved.save(two_small_regions[1:], GRID)
    assert not damaged.exists()
    assert (saved.path / "quarantine" / damaged.name).read_bytes() == b"damaged"
    assert versions(saved) == {(1, 0, 0): 4}


def test_damaged_files_of_unchanged_regions_are_written_anew(
    saved: MapStore, two_small_regions: Regions
) -> None:
    region_files(saved)[0].write_bytes(b"damaged")
    saved.save(two_small_regions, GRID)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 4}


def test_two_writers(saved: MapStore, two_small_regions: Regions) -> None:
    descriptor = os.open(saved.path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        with pytest.raises(OutputError, match="another program"):
            saved.save(two_small_regions, GRID)
        assert versions(saved)
    finally:
        os.close(descriptor)
    saved.save(two_small_regions, GRID)


def test_other_folders_are_not_overwritten(tmp_path: Path, two_small_regions: Regions) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        MapStore(tmp_path).save(two_small_regions, GRID)
    assert os.listdir(tmp_path) == ["thesis.tex"]


def test_places_that_cannot_be_written(tmp_path: Path, two_small_regions: Regions) -> None:
    (tmp_path / "file").write_bytes(b"x")
    for place in (tmp_path / "file", tmp_path / "file" / "map.meslam"):
        with pytest.raises(OutputError, match="file"):
            MapStore(place).save(two_small_regions, GRID)


def test_rebuilt_lattice_of_a_single_region(tmp_path: Path, small_region: StoredRegion) -> None:
    T_map_region = np.eye(4)
    grid = RegionGrid(np.array([0.3, -1.0, 1.2]), small_region.side_m, 0.2)
    T_map_region[:3, 3] = grid.center(small_region.index)
    store = MapStore(tmp_path / "one.meslam")
    store.save([replace(small_region, T_map_region=T_map_region)], grid)
    (store.path / "manifest.json").write_bytes(b"")
    assert np.allclose(store.load().grid.origin, grid.origin)
