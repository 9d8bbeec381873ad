from __future__ import annotations

import time

import numpy as np
import pytest

from meslam_core.regions import observed_mask
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED, ObservedMask

TRUNCATION_M = 0.1


def one_ray(direction: tuple[float, float, float], distance_m: float) -> ObservedMask:
    mask = ObservedMask(2.0, 0.1)
    rays = np.array([direction]) / np.linalg.norm(direction)
    mask.integrate(np.zeros(3), rays, np.array([distance_m]), TRUNCATION_M)
    return mask


def fan(count: int, distance_m: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays as of a camera, and their distances to a wall at `distance_m`."""
    generator = np.random.default_rng(0)
    across = generator.uniform([-0.6, -0.4], [0.6, 0.4], (count, 2))
    directions = np.column_stack([np.ones(count), across])
    lengths = np.linalg.norm(directions, axis=1)
    return directions / lengths[:, None], distance_m * lengths


def test_nothing_is_observed_at_first() -> None:
    mask = ObservedMask(1.0, 0.1)
    assert mask.observed_volume_m3 == 0.0
    assert not mask.lookup(np.zeros((1, 3))).any()


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0.3, 0.5, -0.8)])
def test_a_ray_marks_its_way_and_its_end(direction: tuple[float, float, float]) -> None:
    mask = one_ray(direction, 1.0)
    ray = np.array(direction) / np.linalg.norm(direction)
    along = np.linspace(0.0, 1.05, 40)[:, None] * ray
    assert (mask.lookup(along) & OBSERVED > 0).mean() > 0.7
    assert mask.lookup(ray[None] * 1.0) == OBSERVED | NEAR_SURFACE
    assert mask.lookup(ray[None] * 1.07) == OBSERVED | NEAR_SURFACE
    assert mask.lookup(ray[None] * 0.5) == OBSERVED
    assert mask.lookup(ray[None] * 1.4) == 0
    assert mask.lookup(-ray[None] * 0.3) == 0


def test_many_rays_fill_what_a_camera_sees() -> None:
    mask = ObservedMask(3.0, 0.08)
    mask.integrate(np.zeros(3), *fan(8192), TRUNCATION_M)
    depth = np.random.default_rng(1).uniform(0.3, 1.85, 2000)
    across = np.random.default_rng(2).uniform([-0.5, -0.33], [0.5, 0.33], (2000, 2))
    seen = np.column_stack([depth, across * depth[:, None]])
    assert (mask.lookup(seen) & OBSERVED > 0).mean() > 0.99
    wall = np.column_stack([np.full(2000, 2.0), across * 2.0])
    assert (mask.lookup(wall) & NEAR_SURFACE > 0).mean() > 0.99
    behind = np.column_stack([np.full(2000, 2.3), across])
    assert not mask.lookup(behind).any()


def test_rays_that_leave_the_cube_mark_only_what_is_inside() -> None:
    mask = one_ray((0, 0, 1), 10.0)
    assert mask.lookup(np.array([[0.0, 0.0, 1.95]])) == OBSERVED
    assert not mask.lookup(np.array([[0.0, 0.0, 2.05], [0.0, 0.0, -1.0]])).any()
    assert not (mask.flags & NEAR_SURFACE).any()


def test_a_camera_outside_the_cube() -> None:
    mask = ObservedMask(1.0, 0.1)
    ray = np.array([[1.0, 0.0, 0.0]])
    mask.integrate(np.array([-5.0, 0.05, 0.05]), ray, np.array([5.0]), TRUNCATION_M)
    assert mask.lookup(np.array([[-0.5, 0.05, 0.05]])) == OBSERVED
    assert mask.lookup(np.array([[0.0, 0.05, 0.05]])) == OBSERVED | NEAR_SURFACE


def test_observations_add_up_and_can_be_forgotten() -> None:
    mask = one_ray((1, 0, 0), 1.0)
    before = mask.observed_volume_m3
    mask.integrate(np.zeros(3), np.array([[0.0, 1.0, 0.0]]), np.array([1.0]), TRUNCATION_M)
    assert mask.observed_volume_m3 > 1.5 * before
    assert mask.lookup(np.array([[0.5, 0.0, 0.0]])) == OBSERVED
    mask.clear()
    assert mask.observed_volume_m3 == 0.0


def test_no_rays() -> None:
    mask = ObservedMask(1.0, 0.1)
    mask.integrate(np.zeros(3), np.zeros((0, 3)), np.zeros(0), TRUNCATION_M)
    assert not mask.flags.any()


def test_points_far_outside_and_on_the_border() -> None:
    mask = ObservedMask(1.0, 0.1)
    mask.flags[:] = OBSERVED
    outside = np.array([[1e30, 0, 0], [0, -1e30, 0], [1.001, 0, 0], [0, 0, -1.001]])
    assert not mask.lookup(outside).any()
    assert mask.lookup(np.array([[-0.999, 0.999, 0.0]])).all()


@pytest.mark.parametrize("count", [2, 24, 118, 122])
@pytest.mark.parametrize("voxel_m", [0.08, 0.1, 0.03])
def test_stored_flags_keep_their_cube(count: int, voxel_m: float) -> None:
    flags = np.zeros((count, count, count), np.uint8)
    mask = ObservedMask.from_flags(flags, voxel_m)
    assert mask.flags.shape == (count, count, count)
    assert mask.half_extent_m == pytest.approx(0.5 * count * voxel_m)


def test_a_keyframe_is_marked_in_real_time() -> None:
    mask = ObservedMask(4.66, 0.08)
    directions, distances = fan(8192, 3.5)
    mask.integrate(np.zeros(3), directions, distances, TRUNCATION_M)
    fastest = np.inf
    for _ in range(5):
        started = time.thread_time()
        mask.integrate(np.zeros(3), directions, distances, TRUNCATION_M)
        fastest = min(fastest, time.thread_time() - started)
    assert fastest < 0.030


def test_the_compiled_kernel_marks_what_the_reference_marks(monkeypatch) -> None:
    pytest.importorskip("meslam_core.field._kernel", reason="the compiled kernel is not built")
    directions, distances = fan(4096, 3.5)
    distances[::7] = 0.0
    compiled, reference = ObservedMask(2.0, 0.08), ObservedMask(2.0, 0.08)
    start = np.array([-0.7, 0.31, 0.123])
    compiled.integrate(start, directions, distances, TRUNCATION_M)
    monkeypatch.setattr(observed_mask, "_kernel", None)
    reference.integrate(start, directions, distances, TRUNCATION_M)
    # Points on a voxel's border may round to either side.
    assert np.count_nonzero(compiled.flags) > 10000
    assert np.count_nonzero(compiled.flags != reference.flags) < 10


def test_the_kernel_refuses_what_does_not_fit() -> None:
    kernel = pytest.importorskip("meslam_core.field._kernel")
    ray = {"directions": np.zeros((1, 3), np.float32), "origin": np.zeros(3, np.float32)}
    numbers = {"voxel_m": 0.1, "truncation_m": 0.1, "along": 1, "at_end": 3}
    cube = np.zeros((4, 4, 4), np.uint8)
    for flags, distance in ((cube[:3], 1.0), (cube.astype(np.float32), 1.0), (cube, 2e3)):
        with pytest.raises(ValueError, match=r"expected|beyond"):
            kernel.mark_rays(flags, distances=np.array([distance], np.float32), **ray, **numbers)
    kernel.mark_rays(cube, distances=np.array([np.nan], np.float32), **ray, **numbers)
    assert not cube.any()
