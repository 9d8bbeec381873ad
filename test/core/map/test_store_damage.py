"""Damage to a stored map is named; what is whole still loads."""

from __future__ import annotations

import json
import os
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.analytic_scene import GRID
from data.stored_maps import Regions, changed, region_files, resealed, versions

from meslam_core.errors import MapError, OutputError
from meslam_core.map import codec
from meslam_core.map.manifest import Manifest
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid


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


def test_what_is_no_file_is_named_and_the_rest_loads(saved: MapStore) -> None:
    first, second = region_files(saved)
    first.unlink()
    for make in (first.mkdir, lambda: os.mkfifo(first), lambda: first.symlink_to("/dev/zero")):
        make()
        loaded = saved.load()
        assert [region.index for region in loaded.regions] == [(1, 0, 0)]
        (warning,) = loaded.warnings
        assert first.name in warning
        first.rmdir() if first.is_dir() else first.unlink()
    assert second.exists()


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


def test_rebuilt_lattice_of_a_single_region(tmp_path: Path, small_region: StoredRegion) -> None:
    T_map_region = np.eye(4)
    grid = RegionGrid(np.array([0.3, -1.0, 1.2]), small_region.side_m, 0.2)
    T_map_region[:3, 3] = grid.center(small_region.index)
    store = MapStore(tmp_path / "one.meslam")
    store.save([replace(small_region, T_map_region=T_map_region)], grid)
    (store.path / "manifest.json").write_bytes(b"")
    assert np.allclose(store.load().grid.origin, grid.origin)


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
