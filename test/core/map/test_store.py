"""What a store keeps: maps come back, and only what changed is written."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID
from data.killed_process import child
from data.stored_maps import Regions, changed, region_files, versions

from meslam_core.errors import MapError, OutputError
from meslam_core.map import codec, lock
from meslam_core.map.lock import locked
from meslam_core.map.manifest import Manifest
from meslam_core.map.store import MapStore


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


def test_a_vanished_folder_is_made_again(saved: MapStore, two_small_regions: Regions) -> None:
    shutil.rmtree(saved.path.parent)
    saved.save(two_small_regions, GRID)
    assert versions(saved) == {(0, 0, 0): 4, (1, 0, 0): 4}


def test_no_map_there(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="does not exist"):
        MapStore(tmp_path / "nowhere").load()
    with pytest.raises(MapError, match="no map"):
        MapStore(tmp_path).load()
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(MapError, match="no folder"):
        MapStore(tmp_path / "file").load()


def test_a_manifest_reads_back(saved: MapStore) -> None:
    data = (saved.path / "manifest.json").read_bytes()
    assert Manifest.from_bytes(data, "manifest.json").to_bytes() == data


def test_two_writers(
    saved: MapStore, two_small_regions: Regions, monkeypatch: pytest.MonkeyPatch
) -> None:
    with locked(saved.path):
        with pytest.raises(OutputError, match=rf"written by process {os.getpid()} \(.*pytest"):
            saved.save(two_small_regions, GRID)
        monkeypatch.setattr(lock, "HELD_LOCKS", saved.path / "none")
        with pytest.raises(OutputError, match="written by another program"):
            saved.save(two_small_regions, GRID)
        assert versions(saved)
    saved.save(two_small_regions, GRID)


def test_the_lock_of_a_killed_writer_is_gone(
    saved: MapStore, two_small_regions: Regions, tmp_path: Path
) -> None:
    def hold_for_ever() -> None:
        with locked(saved.path):
            (tmp_path / "held").touch()
            time.sleep(1000)

    with child(hold_for_ever) as process:
        while not (tmp_path / "held").exists():
            time.sleep(0.01)
        with pytest.raises(OutputError, match=f"process {process} "):
            saved.save(two_small_regions, GRID)
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
