"""Finding how far another device's clock is off, and its poses at our stamps."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.errors import EvaluationError
from meslam_core.evaluation.clock import at_stamps, clock_offset_s
from meslam_core.se3 import Pose, exp
from meslam_core.trajectory import Trajectory


def pose_at(seconds: float) -> Pose:
    """A camera that swings unsteadily while it moves."""
    swing = np.sin(2.0 * seconds) + 0.4 * np.sin(5.3 * seconds)
    return exp(np.array([0.3 * seconds, 0.1 * swing, 0.0, 0.1 * swing, 0.3 * swing, 0.0]))


def path(rate_hz: float, begin_s: float, end_s: float, late_s: float = 0.0) -> Trajectory:
    """Poses whose stamps are late by so much."""
    seconds = np.arange(begin_s, end_s, 1.0 / rate_hz)
    stamps = np.round((seconds + late_s + 100.0) * 1e9).astype(np.int64)
    return Trajectory(stamps, np.array([pose_at(each) for each in seconds]))


@pytest.mark.parametrize("late_s", [-0.085, 0.0, 0.04])
def test_the_offset_of_the_clocks_is_found(late_s):
    estimate, truth = path(15.0, 0.0, 8.0), path(50.0, -1.0, 9.0, late_s)
    mounted = truth.transformed(exp(np.full(6, 0.7)), exp(np.array([0.1, 0, 0, 0.5, 0.2, 0.0])))
    assert clock_offset_s(estimate, mounted) == pytest.approx(late_s, abs=0.006)


def test_without_turning_no_offset_is_claimed():
    stamps = np.arange(50, dtype=np.int64) * 100_000_000
    still = Trajectory(stamps, np.tile(np.eye(4), (50, 1, 1)))
    assert clock_offset_s(still, still) == 0.0


def test_true_poses_are_interpolated():
    estimate, truth = path(15.0, 0.0, 3.0), path(50.0, 0.0, 3.0, late_s=0.03)
    indices, moved = at_stamps(truth, estimate.stamps_ns, offset_s=0.03)
    np.testing.assert_array_equal(moved.stamps_ns, estimate.stamps_ns[indices])
    assert np.abs(moved.positions - estimate.positions[indices]).max() < 1e-3
    assert np.abs(moved.rotations - estimate.rotations[indices]).max() < 2e-3


def test_gaps_and_what_lies_beyond_are_left_out():
    truth = path(50.0, 1.0, 4.0)
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    truth = truth.subset(np.flatnonzero((seconds < 1.0) | (seconds > 2.0)))
    estimate = path(10.0, 0.0, 5.0)
    indices, _ = at_stamps(truth, estimate.stamps_ns)
    covered = (estimate.stamps_ns[indices] - estimate.stamps_ns[0]) * 1e-9
    assert covered.min() > 0.95
    assert covered.max() < 4.05
    assert not ((covered > 2.05) & (covered < 2.95)).any()
    assert (covered > 3.0).any()


def test_truth_of_another_time_is_refused():
    with pytest.raises(EvaluationError, match="same clock"):
        at_stamps(path(50.0, 0.0, 3.0), path(15.0, 50.0, 53.0).stamps_ns)
    with pytest.raises(EvaluationError, match="same clock"):
        at_stamps(path(50.0, 0.0, 0.015), path(15.0, 0.0, 3.0).stamps_ns)
