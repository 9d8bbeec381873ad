"""Odometry on frames of a room whose motion is known exactly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from data.textured_room import CAMERA as SMALL_CAMERA
from data.textured_room import PERIOD_NS, frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import Odometry, make_odometry
from meslam_core.se3 import Pose, exp, inverse, log

METHODS = ["direct", "hybrid", "colored_icp"]
CAMERA = SMALL_CAMERA.scaled(2.0)
POSES = path(9, step_m=0.012, step_deg=0.8)


@cache
def view(number: int) -> RgbdFrame:
    """The view from POSES[number]."""
    return frame_at(POSES[number], number, CAMERA)


def true_motion(number: int) -> Pose:
    """Pose of a view in the first one's camera."""
    return inverse(POSES[0]) @ POSES[number]


def odometry(method: str, *overrides: str) -> Odometry:
    config = MeslamConfig.from_overrides(
        [f"odometry.method={method}", "odometry.voxel_size_m=0.03", *overrides]
    )
    return make_odometry(config.odometry, config.sensor)


def blind(frame: RgbdFrame) -> RgbdFrame:
    """The same instant with the lens covered."""
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def distance_and_angle(pose: Pose, true: Pose) -> tuple[float, float]:
    twist = log(inverse(true) @ pose)
    return float(np.linalg.norm(twist[:3])), float(np.rad2deg(np.linalg.norm(twist[3:])))


@pytest.mark.parametrize(
    ("method", "tolerance_m"), [("direct", 0.007), ("hybrid", 0.007), ("colored_icp", 0.015)]
)
def test_a_known_motion_is_found(method, tolerance_m):
    follower = odometry(method)
    estimates = [follower.process(view(number)) for number in range(9)]
    assert all(estimate.valid for estimate in estimates)
    np.testing.assert_array_equal(estimates[0].T_odom_camera, np.eye(4))
    for number, estimate in enumerate(estimates):
        distance, angle = distance_and_angle(estimate.T_odom_camera, true_motion(number))
        assert estimate.stamp_ns == number * PERIOD_NS
        assert distance < tolerance_m, number
        assert angle < 0.5, number


@pytest.mark.parametrize("method", METHODS)
def test_turning_about_the_optical_axis_turns_the_scene(method):
    """Every corner of a cube's image moves; the answer is known to a fraction of a degree."""
    start = path(1)[0]
    turned = start @ exp(np.array([0, 0, 0, 0, 0, np.deg2rad(5.0)]))
    follower = odometry(method)
    follower.process(frame_at(start, 0, CAMERA))
    estimate = follower.process(frame_at(turned, 1, CAMERA))
    assert estimate.valid
    twist = log(estimate.T_odom_camera)
    assert np.rad2deg(twist[5]) == pytest.approx(5.0, abs=0.2)
    assert np.linalg.norm(twist[:3]) < 0.006
    assert np.rad2deg(np.abs(twist[3:5])).max() < 0.2


@pytest.mark.parametrize("method", METHODS)
def test_fast_rotation_is_followed_by_its_own_guess(method):
    # 4 degrees a frame; from no guess at all the last frames would be out of reach.
    poses = path(8, step_m=0.005, step_deg=4.0)
    follower = odometry(method)
    estimates = [follower.process(frame_at(pose, n, CAMERA)) for n, pose in enumerate(poses)]
    distance, angle = distance_and_angle(estimates[-1].T_odom_camera, inverse(poses[0]) @ poses[-1])
    assert distance < 0.03
    assert angle < 1.0


@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_is_positive_and_of_the_size_of_the_errors(method):
    follower = odometry(method)
    estimate = [follower.process(view(number)) for number in range(3)][-1]
    covariance = estimate.covariance
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6)
    error = log(inverse(true_motion(2)) @ estimate.T_odom_camera)
    assert np.sqrt(error @ np.linalg.solve(covariance, error) / 6) < 4.0
    deviations = np.sqrt(np.diag(covariance))
    assert deviations[:3].max() < 0.02
    assert deviations[3:].max() < np.deg2rad(1.0)
    assert 0.4 < estimate.fitness <= 1.0
    assert 1e-4 < estimate.residual_m < 0.03


@pytest.mark.parametrize("method", METHODS)
def test_a_frame_without_depth_is_reported_and_the_next_is_found_again(method):
    follower = odometry(method)
    estimates = [follower.process(view(number)) for number in range(3)]
    estimates.append(follower.process(blind(view(3))))
    estimates += [follower.process(view(number)) for number in (4, 5)]
    covered, last = estimates[3], estimates[5]
    assert not covered.valid
    assert covered.reason
    assert np.linalg.eigvalsh(covered.covariance).min() >= 0.5
    # Without sight it continues the last motion.
    assert distance_and_angle(covered.T_odom_camera, true_motion(3))[0] < 0.015
    assert last.valid
    assert distance_and_angle(last.T_odom_camera, true_motion(5))[0] < 0.015


@pytest.mark.parametrize("method", METHODS)
def test_a_recording_may_begin_without_sight(method):
    follower = odometry(method)
    for number in range(3):
        assert np.isfinite(follower.process(blind(view(number))).T_odom_camera).all()
    estimates = [follower.process(view(number)) for number in range(3, 6)]
    assert estimates[-1].valid
    motion = inverse(estimates[-2].T_odom_camera) @ estimates[-1].T_odom_camera
    assert distance_and_angle(motion, inverse(POSES[4]) @ POSES[5])[0] < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_an_unrelated_view_is_not_believed(method):
    follower = odometry(method, "odometry.min_fitness=0.7")
    start = path(1)[0]
    follower.process(frame_at(start, 0, CAMERA))
    elsewhere = start @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(170.0), 0.0]))
    estimate = follower.process(frame_at(elsewhere, 1, CAMERA))
    assert not estimate.valid
    assert estimate.reason


def test_motion_beyond_the_limits_is_not_believed():
    follower = odometry("direct", "odometry.max_speed_m_s=0.1")
    poses = path(2, step_m=0.03)
    follower.process(frame_at(poses[0], 0))
    estimate = follower.process(frame_at(poses[1], 1))
    assert not estimate.valid
    assert "impossible motion" in estimate.reason


def test_drift_stays_small_while_a_keyframe_serves():
    """Registering against a keyframe does not add up errors from frame to frame."""
    follower = odometry("direct")
    for time, number in enumerate([0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]):
        estimate = follower.process(replace(view(number), stamp_ns=time * PERIOD_NS))
    distance, angle = distance_and_angle(estimate.T_odom_camera, np.eye(4))
    assert distance < 0.005
    assert angle < 0.2


def test_large_images_are_reduced():
    large = CAMERA.scaled(2.0)
    follower = odometry("direct")
    poses = path(2)
    for number, pose in enumerate(poses):
        estimate = follower.process(frame_at(pose, number, large))
    distance, angle = distance_and_angle(estimate.T_odom_camera, inverse(poses[0]) @ poses[1])
    assert distance < 0.004
    assert angle < 0.2
