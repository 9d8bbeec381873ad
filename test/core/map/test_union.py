"""Two robots' maps in a common frame, opened and stored as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored

from meslam_core.errors import MapError
from meslam_core.map.manifest import OFF_LATTICE
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.map.union import MapUnion
from meslam_core.regions.grid import RegionGrid
from meslam_core.regions.observed_mask import OBSERVED

OTHER_GRID = RegionGrid(np.array([0.9, 0.3, -0.2]), GRID.side_m, GRID.overlap)
LEFT, RIGHT = 0.5, -0.5


def seen_by(region: StoredRegion, low_x: float, high_x: float) -> StoredRegion:
    """A region that observed only a slab of the room, map frame [m]."""
    mask = region.mask
    count = mask.flags.shape[0]
    x = (np.arange(count) + 0.5) * mask.voxel_m - mask.half_extent_m + region.T_map_region[0, 3]
    mask.flags[(x < low_x) | (x > high_x)] = 0
    return region


@pytest.fixture
def first(tmp_path: Path, scene: SphereInRoom) -> MapStore:
    """The map of a robot that saw the room up to x = LEFT."""
    store = MapStore(tmp_path / "first.meslam")
    store.save([seen_by(stored(learnt_field(), scene), -9.0, LEFT)], GRID)
    return store


@pytest.fixture
def second(tmp_path: Path, scene: SphereInRoom) -> MapStore:
    """That of another, on another lattice, whose region clashes: the room from x = RIGHT on."""
    x, y, z = OTHER_GRID.origin
    store = MapStore(tmp_path / "second.meslam")
    region = stored(learnt_field(), scene, center=(float(x), float(y), float(z)), version=7)
    store.save([seen_by(region, RIGHT, 9.0)], OTHER_GRID, precision="fp16")
    return store


def test_regions_lie_side_by_side(first: MapStore, second: MapStore, scene: SphereInRoom) -> None:
    neural_map = MapUnion([first.path, second.path]).neural_map()
    points = np.array([[-1.0, 0.2, 0.1], [1.0, 0.2, 0.1]])
    for store, unknown in ((first, 1), (second, 0)):
        alone = NeuralMap.load(store.path).signed_distance_m(points)
        assert np.isnan(alone[unknown])
        known = 1 - unknown
        assert neural_map.signed_distance_m(points)[known] == alone[known]
    assert np.allclose(neural_map.bounds, [[-1.6] * 3, [1.6] * 3], atol=0.17)


def test_overlapping_regions_are_blended(first: MapStore, second: MapStore) -> None:
    points = np.random.default_rng(0).uniform([-0.4, 0.5, -0.4], [0.4, 1.3, 0.4], (500, 3))
    one, other = (NeuralMap.load(store.path).values(points) for store in (first, second))
    both = MapUnion([first.path, second.path]).neural_map().values(points)
    assert np.array_equal(both.flags, one.flags | other.flags)
    length = 0.25 * GRID.side_m / 2
    weights = [
        np.exp(-np.linalg.norm(points - center, axis=1) / length)
        for center in (GRID.origin, OTHER_GRID.origin)
    ]
    mean = (weights[0] * one.distance + weights[1] * other.distance) / sum(weights)
    assert np.isfinite(mean).all()
    assert np.allclose(both.distance, mean, atol=1e-5)
    assert np.abs(both.distance - one.distance).max() > 1e-4


def test_one_mesh_without_a_seam(first: MapStore, second: MapStore, scene: SphereInRoom) -> None:
    neural_map = MapUnion([first.path, second.path]).neural_map()
    mesh = extract_mesh(neural_map, 0.05)
    error = np.abs(scene.distance_m(mesh.vertices.astype(float)))
    assert np.median(error) < 0.003
    area = 6 * (2 * scene.wall_m) ** 2 + 4 * np.pi * scene.radius_m**2
    assert mesh.triangle_areas_m2.sum() == pytest.approx(area, rel=0.02)
    middle = np.abs(mesh.vertices[:, 0]) < 0.6
    assert np.quantile(error[middle], 0.99) < 0.015


def test_the_merged_map_answers_the_same(tmp_path: Path, first: MapStore, second: MapStore) -> None:
    union = MapUnion([first.path, second.path])
    merged = MapStore(tmp_path / "merged.meslam")
    assert union.save(merged.path) == 2
    loaded = merged.load()
    assert [region.index for region in loaded.regions] == [(0, 0, 0), (0, 0, OFF_LATTICE)]
    assert [region.version for region in loaded.regions] == [1, 7]
    assert np.array_equal(loaded.grid.origin, GRID.origin)
    assert loaded.map_id not in {each.map_id for each in union.maps}
    for region, original in zip(loaded.regions, union.regions, strict=True):
        assert np.array_equal(region.parameters, original.parameters)
        assert np.array_equal(region.T_map_region, original.T_map_region)
    assert loaded.encoded[0, 0, 0] == first.load().encoded[0, 0, 0]
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 3))
    expected = union.neural_map().values(points)
    answer = NeuralMap.load(merged.path).values(points)
    assert np.array_equal(answer.distance, expected.distance, equal_nan=True)


def test_a_region_of_the_same_lattice_keeps_its_free_place(
    tmp_path: Path, two_small_regions: list[StoredRegion]
) -> None:
    here, there = two_small_regions
    changed = replace(here, parameters=here.parameters * np.float32(0.5))
    paths = [tmp_path / f"{number}.meslam" for number in range(3)]
    for path, regions in zip(paths, ([here], [here, there], [changed]), strict=True):
        MapStore(path).save(regions, GRID)
    merged = MapStore(tmp_path / "merged.meslam")
    assert MapUnion(paths).save(merged.path) == 3
    indices = [region.index for region in merged.load().regions]
    assert indices == [(0, 0, 0), (1, 0, 0), (0, 0, OFF_LATTICE)]
    again = MapStore(tmp_path / "again.meslam")
    assert MapUnion([paths[1], merged.path, paths[2]]).save(again.path) == 3
    other_way = MapStore(tmp_path / "other.meslam")
    assert MapUnion([paths[2], merged.path]).save(other_way.path) == 3
    assert {region.index for region in other_way.load().regions} == {
        (0, 0, 0), (1, 0, 0), (0, 0, OFF_LATTICE)
    }  # fmt: skip


def test_a_map_may_be_merged_into_itself(first: MapStore, second: MapStore) -> None:
    assert MapUnion([first.path, second.path]).save(first.path) == 2
    assert len(first.load().regions) == 2
    assert MapUnion([first.path, second.path]).save(first.path) == 2


def test_a_merged_map_is_rebuilt_without_its_manifest(
    tmp_path: Path, first: MapStore, second: MapStore
) -> None:
    merged = MapStore(tmp_path / "merged.meslam")
    MapUnion([second.path, first.path]).save(merged.path)
    (merged.path / "manifest.json").write_bytes(b"")
    loaded = merged.load()
    assert len(loaded.regions) == 2
    assert np.allclose(loaded.grid.origin, OTHER_GRID.origin)
    assert loaded.grid.overlap == pytest.approx(GRID.overlap)


def test_damage_is_stated_and_the_rest_joined(
    tmp_path: Path, two_small_regions: list[StoredRegion]
) -> None:
    for name in ("a", "b"):
        MapStore(tmp_path / name).save(two_small_regions, GRID)
    damaged = next((tmp_path / "a").glob("region_1_*"))
    damaged.write_bytes(b"gone")
    union = MapUnion([tmp_path / "a", tmp_path / "b"])
    assert damaged.name in union.damages[0]
    assert [region.index for region in union.regions] == [(0, 0, 0), (1, 0, 0)]


def test_maps_of_other_settings_cannot_be_joined(
    tmp_path: Path, two_small_regions: list[StoredRegion]
) -> None:
    here, there = two_small_regions
    other = replace(there.architecture, truncation_m=0.2)
    MapStore(tmp_path / "a").save([here], GRID)
    MapStore(tmp_path / "b").save([replace(there, architecture=other)], GRID)
    union = MapUnion([tmp_path / "a", tmp_path / "b"])
    with pytest.raises(MapError, match="same settings"):
        union.save(tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_what_is_no_map_is_named(tmp_path: Path, first: MapStore) -> None:
    with pytest.raises(MapError, match="nowhere"):
        MapUnion([first.path, tmp_path / "nowhere"])


def test_no_unobserved_space_becomes_known(first: MapStore, second: MapStore) -> None:
    union = MapUnion([first.path, second.path]).neural_map()
    points = np.random.default_rng(2).uniform(-2.0, 2.0, (2000, 3))
    alone = [NeuralMap.load(store.path).flags(points) for store in (first, second)]
    assert np.array_equal(union.flags(points) & OBSERVED, (alone[0] | alone[1]) & OBSERVED)
