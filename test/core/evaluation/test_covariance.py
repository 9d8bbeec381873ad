"""Whether covariances are found right, too small or too large."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.errors import EvaluationError
from meslam_core.evaluation.covariance import calibration, covariance_entries, pose_errors
from meslam_core.se3 import exp
from meslam_core.trajectory import Trajectory

RNG = np.random.default_rng


def walk(count: int = 400) -> Trajectory:
    """40 s through a room, looking around."""
    seconds = np.arange(count) * 0.1
    twists = np.stack(
        [
            np.sin(0.3 * seconds),
            np.cos(0.5 * seconds),
            0.1 * seconds,
            0.3 * np.sin(0.9 * seconds),
            0.4 * np.sin(0.7 * seconds),
            0.2 * np.cos(1.1 * seconds),
        ],
        axis=1,
    )
    stamps = np.round(seconds * 1e9).astype(np.int64)
    return Trajectory(stamps, np.array([exp(twist) for twist in twists]))


def moved(truth: Trajectory, twists: np.ndarray) -> Trajectory:
    """Poses turned and shifted about the camera, map axes."""
    poses = truth.poses.copy()
    for pose, twist in zip(poses, twists, strict=True):
        pose[:3, :3] = exp(np.concatenate([np.zeros(3), twist[3:]]))[:3, :3] @ pose[:3, :3]
        pose[:3, 3] += twist[:3]
    return Trajectory(truth.stamps_ns, poses)


def test_right_covariances_hold_95_percent():
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0]]) * 1e-4
    errors = RNG(0).multivariate_normal(np.zeros(3), covariance, 20000)
    found = calibration(errors, np.tile(covariance, (len(errors), 1, 1)))
    assert found.held == pytest.approx(0.95, abs=0.01)
    assert found.nees == pytest.approx(1.0, abs=0.03)
    assert found.error == pytest.approx(np.sqrt(7e-4), rel=0.02)
    assert found.predicted == pytest.approx(np.sqrt(7e-4))


@pytest.mark.parametrize(("factor", "held"), [(0.25, 0.42), (4.0, 1.0)])
def test_covariances_of_a_wrong_size_show(factor, held):
    errors = RNG(1).normal(0.0, 0.01, (20000, 3))
    found = calibration(errors, np.tile(factor * 1e-4 * np.eye(3), (len(errors), 1, 1)))
    assert found.held == pytest.approx(held, abs=0.02)
    assert found.nees == pytest.approx(1.0 / factor, rel=0.03)
    assert found.sigma_ratio == pytest.approx(1.126 * np.sqrt(factor), rel=0.03)


def test_covariances_that_are_none_are_refused():
    with pytest.raises(EvaluationError, match="positive definite"):
        calibration(np.ones((2, 3)), np.zeros((2, 3, 3)))
    with pytest.raises(EvaluationError, match="expected"):
        calibration(np.ones((2, 3)), np.tile(np.eye(3), (3, 1, 1)))
    with pytest.raises(EvaluationError, match="expected"):
        calibration(np.zeros((0, 3)), np.zeros((0, 3, 3)))


def test_drift_is_measured_from_the_first_second():
    truth = walk()
    drift = np.zeros((len(truth), 6))
    drift[:, 0] = 0.001 * np.maximum(np.arange(len(truth)) - 10, 0)
    drift[200:, 5] = 0.02
    elsewhere = truth.transformed(exp(np.array([3.0, 2.0, 1.0, 0.3, -0.5, 1.0])))
    errors = pose_errors(moved(truth, drift), elsewhere)
    np.testing.assert_array_equal(errors.frames, np.arange(10, len(truth)))
    np.testing.assert_allclose(errors.shifts_m, drift[10:, :3], atol=1e-9)
    np.testing.assert_allclose(errors.turns_rad, drift[10:, 3:], atol=1e-9)
    assert errors.path_m[-1] == pytest.approx(truth.length_m)
    whole = pose_errors(moved(truth, drift), elsewhere, origin_s=None)
    assert len(whole.frames) == len(truth)
    assert np.square(whole.shifts_m).sum() < 0.5 * np.square(errors.shifts_m).sum()


def test_a_sensor_elsewhere_on_the_mount_and_on_its_own_clock_is_no_error():
    truth = walk()
    T_camera_sensor = exp(np.array([0.05, -0.02, 0.1, 0.1, 0.2, -0.1]))
    sensor = truth.transformed(np.eye(4), T_camera_sensor)
    late = Trajectory(sensor.stamps_ns + 40_000_000, sensor.poses)
    errors = pose_errors(truth, late, hand_eye=True, fit_clock=True)
    assert errors.clock_offset_s == pytest.approx(0.04, abs=0.011)
    assert np.linalg.norm(errors.shifts_m, axis=1).max() < 0.01
    wrong = pose_errors(truth, late, hand_eye=True)
    assert np.linalg.norm(wrong.shifts_m, axis=1).max() > 0.03


def test_the_report_tells_position_and_rotation_apart():
    truth = walk()
    noise = RNG(2).normal(0.0, 1.0, (len(truth), 6)) * np.repeat([0.02, 0.01], 3)
    noise[:10] = 0.0
    covariances = np.tile(np.diag(np.repeat([0.02**2, 0.002**2], 3)), (len(truth), 1, 1))
    entries = covariance_entries(moved(truth, noise), covariances, truth)
    assert entries["covariance_position_held"] == pytest.approx(0.95, abs=0.03)
    assert entries["covariance_position_nees"] == pytest.approx(1.0, abs=0.15)
    assert entries["covariance_rotation_held"] < 0.2
    assert entries["covariance_rotation_nees"] == pytest.approx(25.0, rel=0.15)


def test_a_trajectory_of_a_second_tells_nothing():
    truth = walk().subset(np.arange(10))
    with pytest.raises(EvaluationError, match="first 1 s"):
        pose_errors(truth, truth)
    entries = covariance_entries(truth, np.tile(np.eye(6), (10, 1, 1)), truth)
    assert set(entries.values()) == {None}
