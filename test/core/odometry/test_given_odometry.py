"""Odometry from elsewhere: what is taken from given poses, and when they do not serve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.drifting_odometry import drifting
from data.synthetic_frames import plane_frame

from meslam_core.config import MeslamConfig
from meslam_core.odometry import (
    GivenOdometry,
    MotionNoise,
    OdometryEstimate,
    given_noise,
    make_odometry,
)
from meslam_core.se3 import exp, inverse, log, rotation_angle
from meslam_core.trajectory import Trajectory

PERIOD_NS = 100_000_000
STEP = np.array([0.02, 0.0, 0.1, 0.0, 0.05, 0.0])
ELSEWHERE = exp(np.array([5.0, -3.0, 1.0, 0.5, 1.5, -0.4]))


def trajectory(numbers: list[int]) -> Trajectory:
    """The same steady motion, known at some multiples of a period."""
    poses = [ELSEWHERE @ exp(number * STEP) for number in numbers]
    return Trajectory(np.array(numbers) * PERIOD_NS, np.array(poses))


def given(poses: Trajectory, *overrides: str) -> GivenOdometry:
    return GivenOdometry(poses, MeslamConfig.from_overrides(overrides).odometry)


def at(odometry: GivenOdometry, periods: float) -> OdometryEstimate:
    return odometry.process(replace(plane_frame(0), stamp_ns=round(periods * PERIOD_NS)))


def test_motions_are_those_of_the_poses_whatever_frame_they_are_in():
    odometry = given(trajectory([0, 1, 2, 3]))
    first, last = at(odometry, 0), at(odometry, 3)
    motion = inverse(first.T_odom_camera) @ last.T_odom_camera
    np.testing.assert_allclose(log(motion), 3 * STEP, atol=1e-9)
    assert first.valid
    assert last.valid
    assert last.stamp_ns == 3 * PERIOD_NS


def test_poses_are_interpolated_to_the_images():
    odometry = given(trajectory([0, 1, 2, 3]))
    motion = inverse(at(odometry, 0.3).T_odom_camera) @ at(odometry, 1.8).T_odom_camera
    np.testing.assert_allclose(log(motion), 1.5 * STEP, atol=1e-9)


@pytest.mark.parametrize(
    ("periods", "reason"),
    [
        (-0.5, "begin 0.050 s after the image"),
        (3.5, "a gap of 0.300 s"),
        (6.25, "end 0.125 s before the image"),
    ],
)
def test_an_image_without_poses_next_to_it_has_no_odometry_and_is_told_why(periods, reason):
    odometry = given(trajectory([0, 1, 2, 5]))
    estimate = at(odometry, periods)
    assert not estimate.valid
    assert reason in estimate.reason
    assert np.isfinite(estimate.T_odom_camera).all()


def test_the_gap_that_is_bridged_is_a_setting():
    poses = trajectory([0, 1, 2, 5])
    assert not at(given(poses), 4).valid
    estimate = at(given(poses, "odometry.given_gap_s=0.31"), 4)
    assert estimate.valid
    np.testing.assert_allclose(estimate.T_odom_camera, ELSEWHERE @ exp(4 * STEP), atol=1e-9)


def test_a_known_instant_within_a_gap_needs_no_interpolation():
    assert at(given(trajectory([0, 5, 10])), 5).valid


@pytest.mark.parametrize("jump", [[10.0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 2.0]])
def test_a_jump_is_told_and_left_out(jump):
    steady = trajectory([0, 1, 2, 3, 4])
    poses = steady.poses.copy()
    poses[2:] = exp(np.array(jump)) @ poses[2:]
    odometry = given(Trajectory(steady.stamps_ns, poses))
    estimates = [at(odometry, number) for number in range(5)]
    assert [estimate.valid for estimate in estimates] == [True, True, False, True, True]
    assert "the given poses jump by" in estimates[2].reason
    for before, after in ((0, 1), (2, 3), (3, 4)):
        motion = inverse(estimates[before].T_odom_camera) @ estimates[after].T_odom_camera
        np.testing.assert_allclose(log(motion), STEP, atol=1e-9)
    # The camera is where it was: what came with the jump is unknown.
    still = inverse(estimates[1].T_odom_camera) @ estimates[2].T_odom_camera
    np.testing.assert_allclose(still, np.eye(4), atol=1e-9)


def test_a_fast_camera_does_not_jump():
    poses = np.array([exp(number * np.array([0.25, 0, 0, 0, 0, 0.4])) for number in range(4)])
    odometry = given(Trajectory(np.arange(4) * PERIOD_NS, poses))
    assert all(at(odometry, number).valid for number in range(4))


def test_uncertainty_grows_with_the_way_as_wheels_do():
    noise = given_noise(
        MeslamConfig.from_overrides(
            ["odometry.given_sigma_m=0.001", "odometry.given_sigma_deg=0.2"]
        ).odometry
    )
    metre = np.eye(4)
    metre[0, 3] = 1.0
    assert noise.deviations(np.eye(4)) == (0.001, pytest.approx(np.deg2rad(0.2)))
    assert noise.deviations(metre) == (pytest.approx(0.021), pytest.approx(np.deg2rad(1.2)))
    turn = exp(np.array([0, 0, 0, 0, 0, 0.5]))
    assert noise.deviations(turn)[1] == pytest.approx(np.deg2rad(0.2) + 0.02 * 0.5)


def test_the_covariance_is_that_of_the_motion_since_the_last_image():
    odometry = given(trajectory(list(range(20))))
    at(odometry, 0)
    near, far = at(odometry, 1).covariance, at(odometry, 11).covariance
    np.testing.assert_array_equal(near, np.diag(near.diagonal()))
    assert (far.diagonal() > near.diagonal()).all()
    noise = MotionNoise(0.002, np.deg2rad(0.1), 0.02, np.deg2rad(1.0))
    distance, angle = noise.deviations(exp(10 * STEP))
    np.testing.assert_allclose(far.diagonal()[[0, 5]], [distance**2, angle**2], rtol=1e-6)


def test_without_odometry_no_estimate_is_valid():
    config = MeslamConfig.from_overrides(["odometry.method=none"])
    estimate = make_odometry(config.odometry, config.sensor).process(plane_frame(7))
    assert not estimate.valid
    assert estimate.stamp_ns == plane_frame(7).stamp_ns
    assert estimate.reason


def test_the_drift_that_tests_add_is_what_it_says():
    straight = np.tile(np.eye(4), (101, 1, 1))
    straight[:, 2, 3] = np.linspace(0.0, 2.0, 101)
    truth = Trajectory(np.arange(101) * PERIOD_NS, straight)
    poses = drifting(truth, share=0.02, deg_m=1.0)
    assert poses.length_m == pytest.approx(2.04)
    turned = inverse(poses.poses[0]) @ poses.poses[-1]
    assert np.rad2deg(rotation_angle(turned)) == pytest.approx(2.0, abs=1e-6)
