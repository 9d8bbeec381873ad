"""Gauss-Newton on a field that learnt the textured room."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.config import TrackingConfig
from meslam_core.mapping.keyframes import Rays, rays_at
from meslam_core.se3 import Pose, exp, inverse, log
from meslam_core.tracking.field_tracker import FieldTracker
from meslam_core.tracking.pixels import choose_pixels, trusted_pixels

TRACKER = FieldTracker(TrackingConfig())


def rays_of(room, number: int, seed: int = 0) -> Rays:
    frame = room.frame(number)
    pixels = trusted_pixels(frame.depth_m, room.config.sensor)
    return rays_at(frame, *choose_pixels(pixels, 1500, np.random.default_rng(seed)))


def disturbed(pose: Pose, distance_m: float, angle_deg: float, seed: int) -> Pose:
    """A pose moved and turned about the camera centre in random directions."""
    generator = np.random.default_rng(seed)
    shift, axis = generator.normal(size=(2, 3))
    moved = pose.copy()
    turn = np.deg2rad(angle_deg) * axis / np.linalg.norm(axis)
    moved[:3, :3] = exp(np.concatenate([np.zeros(3), turn]))[:3, :3] @ pose[:3, :3]
    moved[:3, 3] += distance_m * shift / np.linalg.norm(shift)
    return moved


def errors(pose: Pose, true: Pose) -> tuple[float, float]:
    """Distance [m] and angle [deg]."""
    twist = log(inverse(true) @ pose)
    return float(np.linalg.norm(pose[:3, 3] - true[:3, 3])), np.rad2deg(np.linalg.norm(twist[3:]))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("number", [5, 25])
def test_a_pose_is_recovered_from_two_centimetres_and_one_degree(mapped_room, number, seed):
    true = mapped_room.poses[number]
    guess = disturbed(true, 0.02, 1.0, seed)
    result = TRACKER.align(mapped_room.region, rays_of(mapped_room, number), guess)
    distance, angle = errors(result.T_map_camera, true)
    assert distance < 0.006
    assert angle < 0.25
    assert result.residual_m < 0.008
    assert result.inlier_ratio > 0.9
    assert result.observed_ratio > 0.9


def test_few_steps_suffice(mapped_room):
    guess = disturbed(mapped_room.poses[5], 0.02, 1.0, 3)
    result = TRACKER.align(mapped_room.region, rays_of(mapped_room, 5), guess)
    assert result.converged
    assert result.iterations <= 8


def test_the_result_does_not_depend_on_the_guess(mapped_room):
    rays = rays_of(mapped_room, 15)
    poses = [
        TRACKER.align(
            mapped_room.region, rays, disturbed(mapped_room.poses[15], 0.02, 1.0, seed)
        ).T_map_camera
        for seed in range(4)
    ]
    for pose in poses[1:]:
        distance, angle = errors(pose, poses[0])
        assert distance < 0.002
        assert angle < 0.1


# Directions in which no wall comes to lie on another by chance.
@pytest.mark.parametrize("seed", [2, 5, 7])
def test_a_pose_far_off_is_reported_as_a_bad_fit(mapped_room, seed):
    lost = disturbed(mapped_room.poses[5], 0.8, 60.0, seed)
    result = TRACKER.align(mapped_room.region, rays_of(mapped_room, 5), lost)
    limits = mapped_room.config.tracking
    assert (
        result.inlier_ratio < limits.min_inlier_ratio
        or result.observed_ratio < limits.min_observed_ratio
        or result.residual_m > limits.max_residual_m
    )


def test_a_pose_beyond_everything_mapped_stays_where_it_was(mapped_room):
    guess = mapped_room.poses[5].copy()
    guess[:3, 3] += [0.0, 50.0, 0.0]
    result = TRACKER.align(mapped_room.region, rays_of(mapped_room, 5), guess)
    np.testing.assert_allclose(result.T_map_camera, guess, atol=1e-9)
    assert result.inlier_ratio == 0.0
    assert result.observed_ratio == 0.0
    assert not result.converged


def test_the_robust_cost_prefers_the_better_guess(mapped_room):
    rays, true = rays_of(mapped_room, 5), mapped_room.poses[5]
    costs = [
        TRACKER.robust_cost(mapped_room.region, rays, disturbed(true, 0.01 * k, 0.5 * k, 2))
        for k in range(5)
    ]
    assert costs == sorted(costs)
    assert 0.0 <= costs[0] < 0.2


def test_the_best_guess_comes_first(mapped_room):
    rays, true = rays_of(mapped_room, 5), mapped_room.poses[5]
    guesses = [disturbed(true, 0.01 * k, 0.5 * k, 2) for k in (3, 0, 2, 1)]
    ranked = TRACKER.ranked(mapped_room.region, rays, guesses)
    for pose, best in zip(ranked, [1, 3, 2, 0], strict=True):
        np.testing.assert_array_equal(pose, guesses[best])


def test_of_guesses_that_agree_only_the_first_is_kept(mapped_room):
    rays, true = rays_of(mapped_room, 5), mapped_room.poses[5]
    guesses = [true, disturbed(true, 0.0005, 0.02, 0), disturbed(true, 0.0, 0.02, 1)]
    assert len(TRACKER.ranked(mapped_room.region, rays, guesses)) == 1
    assert TRACKER.ranked(mapped_room.region, rays, guesses)[0] is true
    turned = disturbed(true, 0.0, 0.2, 1)
    assert len(TRACKER.ranked(mapped_room.region, rays, [*guesses, turned])) == 2


def test_statistics_are_those_of_the_pose_that_was_found(mapped_room):
    rays = rays_of(mapped_room, 5)
    guess = disturbed(mapped_room.poses[5], 0.02, 1.0, 3)
    found = TRACKER.align(mapped_room.region, rays, guess)
    again = TRACKER.align(mapped_room.region, rays, found.T_map_camera)
    assert found.converged
    assert found.residual_m == pytest.approx(again.residual_m, abs=3e-4)
    assert found.inlier_ratio == pytest.approx(again.inlier_ratio, abs=0.01)
    assert found.observed_ratio == pytest.approx(again.observed_ratio, abs=0.01)


def test_the_information_is_symmetric_and_tells_well_seen_directions(mapped_room):
    result = TRACKER.align(mapped_room.region, rays_of(mapped_room, 5), mapped_room.poses[5])
    information = result.information
    np.testing.assert_allclose(information, information.T, rtol=1e-9)
    assert np.linalg.eigvalsh(information).min() > 0
    # The camera looks along x: walls in front fix that direction best.
    assert information[0, 0] > information[1, 1]


def test_colour_fixes_what_a_bare_wall_leaves_open(mapped_room):
    """Rays that all end on one wall: only colour tells where along it the camera is."""
    frame = mapped_room.frame(5)
    true = mapped_room.poses[5]
    rows, columns = np.mgrid[2:50:2, 2:158:2].reshape(2, -1)
    rays = rays_at(frame, rows, columns)
    ends = (rays.directions * rays.distances_m[:, None]).numpy() @ true[:3, :3].T + true[:3, 3]
    wall = np.abs(ends[:, 0] - 2.1) < 0.01
    rays = Rays(rays.directions[wall], rays.distances_m[wall], rays.colors[wall])
    guess = true.copy()
    guess[:3, 3] += [0.0, 0.015, 0.015]
    blind = FieldTracker(TrackingConfig(color_weight=0.0))
    with_color = errors(TRACKER.align(mapped_room.region, rays, guess).T_map_camera, true)[0]
    without = errors(blind.align(mapped_room.region, rays, guess).T_map_camera, true)[0]
    assert with_color < 0.5 * without
    assert with_color < 0.008


def test_regions_may_lie_turned_in_the_map(build_room):
    room = build_room(400)
    T_new_old = exp(np.array([1.0, -2.0, 0.5, 0.2, -0.4, 0.9]))
    room.region.T_map_region = T_new_old @ room.region.T_map_region
    true = T_new_old @ room.poses[5]
    result = TRACKER.align(room.region, rays_of(room, 5), disturbed(true, 0.02, 1.0, 0))
    assert errors(result.T_map_camera, true)[0] < 0.005
