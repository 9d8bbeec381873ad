"""A save that fails or is killed anywhere leaves the old map or the new one."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from data.analytic_scene import GRID
from data.killed_process import child, killed_at_call, status_of
from data.stored_maps import Regions, changed, region_files, versions

from meslam_core.errors import OutputError
from meslam_core.map import codec
from meslam_core.map.store import MapStore


@contextlib.contextmanager
def failing(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[list[str]]:
    """The `number`-th call to the operating system that changes the disk fails."""
    calls: list[str] = []

    def fragile(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            # A region's file is opened so, to be read alone.
            if name == "open" and arguments[1] & os.O_NONBLOCK:
                return original(*arguments, **named)
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

        def save() -> None:
            MapStore(saved.path).save(two_maps[1], GRID)

        status = killed_at_call(number, save, monkeypatch)
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
