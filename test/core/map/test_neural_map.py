from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom

from meslam_core.config import MapConfig
from meslam_core.errors import MapError
from meslam_core.map.neural_map import FREE, OCCUPIED, UNKNOWN, NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED, ObservedMask
from meslam_core.se3 import exp


def constant_region(
    value: float, center: tuple[float, float, float], index: tuple[int, int, int] = (0, 0, 0)
) -> StoredRegion:
    """A region whose network answers f = `value` and the colour 1/2 everywhere it observed."""
    architecture = Architecture(16, 8, 0.1, 500.0)
    parameters = np.zeros(architecture.parameter_count, np.float32)
    parameters[-4] = value
    mask = ObservedMask(3.0, 0.1)
    mask.flags[:] = OBSERVED | NEAR_SURFACE
    T_map_region = np.eye(4)
    T_map_region[:3, 3] = center
    return StoredRegion(index, T_map_region, 3.0, architecture, parameters, mask, 0, 0, 1)


def room_points(scene: SphereInRoom, count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(4).uniform(-1.6, 1.6, (count, 3))
    return points[np.abs(np.abs(scene.distance_m(points)) - 0.14) > 0.06]


def test_signed_distance_is_positive_behind_surfaces(
    neural_map: NeuralMap, scene: SphereInRoom
) -> None:
    points = scene.sample(6000, 0.06, np.random.default_rng(1))
    truth = -scene.distance_m(points)
    near = np.abs(truth) < 0.06
    distance = neural_map.signed_distance_m(points)
    assert np.median(np.abs(distance - truth)[near]) < 0.003
    assert (distance[truth < -0.2] < -0.08).mean() > 0.995


def test_occupancy_of_the_sphere_and_the_room(neural_map: NeuralMap, scene: SphereInRoom) -> None:
    points = room_points(scene)
    truth = scene.distance_m(points)
    state, probability = neural_map.occupancy(points)
    assert state.dtype == np.int8
    clearly_free, clearly_inside = truth > 0.03, (truth < -0.03) & (truth > -0.09)
    never_seen = truth < -0.2
    assert (state[clearly_free] == FREE).mean() > 0.995
    assert (state[clearly_inside] == OCCUPIED).mean() > 0.995
    assert (state[never_seen] == UNKNOWN).all()
    assert (probability[never_seen] == 0.5).all()
    assert np.median(probability[clearly_free]) < 0.01
    assert np.median(probability[clearly_inside]) > 0.99
    assert np.array_equal(state == OCCUPIED, (probability > 0.5) & (state != UNKNOWN))


def test_a_voxel_that_contains_the_surface_is_occupied(neural_map: NeuralMap) -> None:
    before_the_ball = np.array([[0.0, 0.0, 0.53]])
    assert neural_map.occupancy(before_the_ball)[0] == FREE
    assert neural_map.occupancy(before_the_ball, voxel_m=0.1)[0] == OCCUPIED
    assert neural_map.occupancy(before_the_ball, voxel_m=0.02)[0] == FREE


def test_colors(neural_map: NeuralMap, scene: SphereInRoom) -> None:
    ball = np.random.default_rng(2).normal(size=(300, 3))
    ball *= scene.radius_m / np.linalg.norm(ball, axis=1, keepdims=True)
    assert np.abs(neural_map.color(ball) - [0.9, 0.1, 0.1]).max(axis=1).mean() < 0.05
    wall = np.array([[1.4, 0.3, -0.5], [0.1, -1.4, 0.9]])
    assert np.abs(neural_map.color(wall) - scene.color(wall)).max() < 0.1


def test_density(neural_map: NeuralMap) -> None:
    density = neural_map.density(np.array([[0.9, 0.0, 0.0], [0.0, 0.0, 0.46], [0.0, 0.0, 0.0]]))
    assert density[0] == 0.0
    assert density[1] > 100.0
    assert np.isnan(density[2])


def test_nothing_is_known_where_nobody_looked(neural_map: NeuralMap) -> None:
    far = np.array([[50.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, -40.0]])
    values = neural_map.values(far)
    assert not values.flags.any()
    assert np.isnan(values.distance).all()
    assert np.isnan(values.color).all()
    assert np.isnan(neural_map.signed_distance_m(far)).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_of_any_float_type(neural_map: NeuralMap, dtype: type) -> None:
    points = np.array([[0.0, 0.0, 0.46], [0.9, 0.2, 0.1]], dtype)
    assert neural_map.occupancy(points)[0].tolist() == [OCCUPIED, FREE]


def test_no_points(neural_map: NeuralMap) -> None:
    empty = np.zeros((0, 3))
    assert neural_map.density(empty).shape == (0,)
    assert neural_map.color(empty).shape == (0, 3)
    assert neural_map.occupancy(empty)[0].shape == (0,)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((2, 4)), np.full((1, 3), np.nan)])
def test_malformed_points(neural_map: NeuralMap, points: np.ndarray) -> None:
    with pytest.raises(MapError, match="points"):
        neural_map.values(points)


def test_batches_do_not_change_answers(
    neural_map: NeuralMap, scene: SphereInRoom, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = room_points(scene, 3000)
    whole = neural_map.values(points)
    monkeypatch.setattr("meslam_core.map.neural_map.BATCH", 257)
    parts = neural_map.values(points)
    assert np.array_equal(whole.flags, parts.flags)
    assert np.allclose(whole.distance, parts.distance, atol=1e-5, equal_nan=True)


def test_weights_fall_exponentially_with_the_distance_to_the_centre() -> None:
    config = MapConfig(blend_length=0.4)
    centers = ((0.0, 0.0, 0.0), (2.4, 0.0, 0.0))
    blended = NeuralMap(
        [constant_region(0.0, centers[0]), constant_region(1.0, centers[1], (1, 0, 0))], config
    )
    points = np.random.default_rng(5).uniform([-0.5, -1, -1], [2.9, 1, 1], (50, 3))
    weights = np.exp([-np.linalg.norm(points - center, axis=1) / (0.4 * 1.5) for center in centers])
    expected = weights[1] / weights.sum(axis=0)
    assert np.allclose(blended.values(points).distance, expected, atol=5e-3)
    middle = np.array([[1.2, 0.0, 0.0]])
    assert blended.values(middle).distance == pytest.approx(0.5, abs=5e-3)
    assert blended.values(np.zeros((1, 3))).distance < 0.03


def test_only_regions_that_observed_a_point_answer() -> None:
    first = constant_region(0.0, (0.0, 0.0, 0.0))
    second = constant_region(1.0, (2.4, 0.0, 0.0), (1, 0, 0))
    first.mask.flags[35:] = 0
    points = np.array([[0.6, 0.0, 0.0]])
    assert NeuralMap([first, second]).values(points).distance == pytest.approx(1.0, abs=5e-3)


def test_far_from_all_centres_weights_do_not_vanish() -> None:
    region = constant_region(0.25, (0.0, 0.0, 0.0))
    tiny = MapConfig(blend_length=0.01)
    corner = np.array([[2.9, 2.9, 2.9]])
    assert NeuralMap([region], tiny).values(corner).distance == pytest.approx(0.25, abs=5e-3)


def test_regions_with_the_same_function_show_no_seam(
    region: StoredRegion, neighbour: StoredRegion, neural_map: NeuralMap, scene: SphereInRoom
) -> None:
    both = NeuralMap([region, neighbour])
    points = scene.sample(4000, 0.1, np.random.default_rng(6))
    one, two = neural_map.values(points), both.values(points)
    seen = np.isfinite(one.distance)
    # The compiled kernel computes in bfloat16, so the two are equal but for rounding.
    difference = np.abs(one.distance - two.distance)[seen]
    assert np.median(difference) < 0.005
    assert np.quantile(difference, 0.99) < 0.05
    assert np.array_equal(one.flags[seen] & OBSERVED, two.flags[seen] & OBSERVED)


def test_a_moved_region_takes_its_map_along(
    region: StoredRegion, neural_map: NeuralMap, scene: SphereInRoom
) -> None:
    motion = exp(np.array([4.0, -2.0, 0.5, 0.3, -0.2, 0.9]))
    moved = NeuralMap([replace(region, T_map_region=motion @ region.T_map_region)])
    points = scene.sample(2000, 0.08, np.random.default_rng(7))
    there = points @ motion[:3, :3].T + motion[:3, 3]
    here_values, here_gradient = neural_map.gradient(points)
    there_values, there_gradient = moved.gradient(there)
    same = here_values.flags == there_values.flags
    assert same.mean() > 0.98
    both = same & np.isfinite(here_values.distance)
    assert np.quantile(np.abs(here_values.distance - there_values.distance)[both], 0.99) < 0.03
    turned = here_gradient @ motion[:3, :3].T
    scale = np.linalg.norm(turned[both], axis=1).mean()
    assert np.median(np.linalg.norm((turned - there_gradient)[both], axis=1)) < 0.05 * scale
    low, high = moved.bounds
    inside = there[there_values.flags > 0]
    assert ((inside >= low) & (inside <= high)).all()


def test_gradient_is_the_slope(region: StoredRegion) -> None:
    exact = NeuralMap([region], backend="torch")
    points = np.array([[0.0, 0.1, 0.52], [1.35, 0.2, 0.3], [-0.3, -1.37, 0.5]])
    _, gradient = exact.gradient(points)
    step = 1e-3
    for axis in range(3):
        offset = np.eye(3)[axis] * step
        ahead, back = exact.values(points + offset), exact.values(points - offset)
        slope = (ahead.distance - back.distance) / (2 * step)
        assert np.allclose(gradient[:, axis], slope, atol=0.05)


def test_near_only_leaves_the_rest_unevaluated(neural_map: NeuralMap) -> None:
    points = np.array([[0.0, 0.0, 0.52], [0.9, 0.0, 0.0]])
    values = neural_map.values(points, near_only=True)
    assert np.isfinite(values.distance).tolist() == [True, False]
    assert (values.flags & OBSERVED > 0).all()


def test_observed_volume_counts_overlaps_once(
    region: StoredRegion, neighbour: StoredRegion, neural_map: NeuralMap
) -> None:
    volume = neural_map.observed_volume_m3
    assert volume == pytest.approx(region.mask.observed_volume_m3)
    assert neighbour.mask.observed_volume_m3 > 0.3 * volume
    assert NeuralMap([region, neighbour]).observed_volume_m3 < 1.1 * volume


def test_regions_of_maps_with_other_scales_cannot_be_joined() -> None:
    first = constant_region(0.0, (0.0, 0.0, 0.0))
    other = replace(first, architecture=replace(first.architecture, truncation_m=0.2))
    with pytest.raises(MapError, match="same settings"):
        NeuralMap([first, other])


def test_an_empty_map_says_so() -> None:
    with pytest.raises(MapError, match="no region"):
        NeuralMap([])


def test_unknown_regions_are_named(neural_map: NeuralMap) -> None:
    with pytest.raises(MapError, match=r"\(3, 0, 0\)"):
        neural_map.subset([(0, 0, 0), (3, 0, 0)])


def test_loaded_from_a_store(
    tmp_path: Path, region: StoredRegion, neighbour: StoredRegion, scene: SphereInRoom
) -> None:
    MapStore(tmp_path / "room.meslam").save([region, neighbour], GRID)
    loaded = NeuralMap.load(tmp_path / "room.meslam")
    points = room_points(scene)
    expected = NeuralMap([region, neighbour]).occupancy(points)[0]
    assert (loaded.occupancy(points)[0] == expected).mean() > 0.995
