"""Which registrations are tried, and which of them is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.textured_room import frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.odometry.keyframe_odometry import SAME_MOTION_M, KeyframeOdometry
from meslam_core.odometry.registration import Registration
from meslam_core.se3 import Pose, exp

FRAMES = [frame_at(pose, number) for number, pose in enumerate(path(3))]
TRUE = exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))
"""What registration finds from a start near it."""


class Scripted:
    """Registers well from near the truth and badly, staying where it is, from anywhere else."""

    def __init__(self, proposed: list[Pose], searched: Pose, **bad: float) -> None:
        self.starts: list[Pose] = []
        self.searches = 0
        self.true, self.basin_m = TRUE, 0.005
        self._proposed, self._searched = proposed, searched
        self._bad = {"fitness": 0.9, "agreement": 0.9, **bad}

    def prepare(self, frame):
        return frame

    def propose(self, source, target):
        return iter(self._proposed)

    def search(self, source, target, T_target_source):
        self.searches += 1
        return self._searched

    def register(self, source, target, T_target_source):
        self.starts.append(T_target_source)
        if np.linalg.norm((T_target_source - self.true)[:3, 3]) < self.basin_m:
            return Registration(self.true, np.eye(6), 0.95, 0.001, 0.95)
        return Registration(T_target_source, np.eye(6), residual_m=0.01, **self._bad)


def second_estimate(registrar: Scripted):
    config = MeslamConfig()
    follower = KeyframeOdometry(registrar, config.odometry, config.sensor)
    follower.process(FRAMES[0])
    return follower.process(FRAMES[1])


def test_a_good_fit_after_a_slow_motion_is_taken_at_once():
    registrar = Scripted([], TRUE)
    assert second_estimate(registrar).valid
    assert len(registrar.starts) == 1
    assert registrar.searches == 0


@pytest.mark.parametrize(
    "bad",
    [{"fitness": 0.5, "agreement": 0.45}, {"fitness": 0.3}, {"agreement": 0.2}],
    ids=["colour", "fitness", "agreement"],
)
@pytest.mark.parametrize("helper", ["proposal", "search"])
def test_a_bad_fit_is_searched_for_a_better_one(bad, helper):
    far = exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    proposed, searched = ([TRUE], far) if helper == "proposal" else ([far], TRUE)
    estimate = second_estimate(Scripted(proposed, searched, **bad))
    assert estimate.valid
    np.testing.assert_allclose(estimate.T_odom_camera, TRUE, atol=1e-9)


def test_a_weak_fit_is_taken_where_all_looks_alike_and_the_motion_came_as_predicted():
    registrar = Scripted([TRUE], TRUE, fitness=0.5, agreement=0.49)
    registrar.basin_m = 0.0
    assert second_estimate(registrar).valid
    assert len(registrar.starts) == 1


@pytest.mark.parametrize(("surprise_m", "searches"), [(0.0, False), (0.005, False), (0.02, True)])
def test_a_fast_motion_that_came_as_predicted_is_taken_at_once(surprise_m, searches):
    config = MeslamConfig()
    registrar = Scripted([], np.eye(4))
    registrar.basin_m = 1.0
    follower = KeyframeOdometry(registrar, config.odometry, config.sensor)
    for number, frame in enumerate(FRAMES):
        moved_m = 0.06 * number + (surprise_m if number == 2 else 0.0)
        registrar.true = exp(np.array([moved_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
        registrar.searches = 0
        assert follower.process(frame).valid
    assert (registrar.searches > 0) == searches


def test_a_start_where_another_registration_ended_is_not_tried_again():
    near = TRUE @ exp(np.array([0.5 * SAME_MOTION_M, 0.0, 0.0, 0.0, 0.0, 0.0]))
    registrar = Scripted([TRUE, near], near, agreement=0.2)
    assert second_estimate(registrar).valid
    assert len(registrar.starts) == 2


def test_what_fits_nowhere_is_reported():
    far = exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    estimate = second_estimate(Scripted([], far, agreement=0.2))
    assert not estimate.valid
    assert "20%" in estimate.reason


@pytest.mark.parametrize(
    ("elapsed_s", "distance_m", "valid"), [(0.6, 0.7, True), (1.5, 0.3, True), (1.5, 0.7, False)]
)
def test_a_far_motion_over_a_gap_is_a_guess(elapsed_s, distance_m, valid):
    """Two views that share little fit in several ways; what fits best is still the best guess."""
    registrar = Scripted([exp(np.array([distance_m, 0.0, 0.0, 0.0, 0.0, 0.0]))], TRUE)
    registrar.true = exp(np.array([distance_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    registrar.basin_m = 0.1
    registrar._bad = {"fitness": 0.0, "agreement": 0.0}
    config = MeslamConfig()
    follower = KeyframeOdometry(registrar, config.odometry, config.sensor)
    follower.process(FRAMES[0])
    late_ns = FRAMES[0].stamp_ns + round(elapsed_s * 1e9)
    estimate = follower.process(replace(FRAMES[1], stamp_ns=late_ns))
    assert estimate.valid is valid
    assert (estimate.reason == "") is valid
    np.testing.assert_allclose(estimate.T_odom_camera, registrar.true, atol=1e-9)
    # From there odometry goes on.
    registrar.true = np.eye(4)
    after = follower.process(replace(FRAMES[2], stamp_ns=late_ns + 66_000_000))
    assert after.valid
