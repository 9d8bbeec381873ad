"""Poses of the frames so far, tied to keyframes that move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry import MotionNoise, OdometryEstimate
from meslam_core.se3 import Pose, exp, inverse, log
from meslam_core.tracking.frame_history import (
    MAX_EXTRAPOLATION,
    MAX_ODOMETRY_GAP,
    FrameHistory,
    KeyframePoses,
)

PERIOD_NS = 50_000_000
STEP = np.array([0.02, -0.01, 0.005, 0.01, 0.03, -0.02])
START = exp(np.array([1.0, -2.0, 0.5, 0.4, -0.3, 0.9]))


def store(*poses: Pose) -> KeyframeStore:
    rays = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1), torch.zeros(1, 3))
    keyframes = KeyframeStore(1, torch.device("cpu"))
    for number, pose in enumerate(poses):
        keyframes.add(number, pose, rays)
    return keyframes


def estimate(pose: Pose, valid: bool = True) -> OdometryEstimate:
    return OdometryEstimate(0, pose, np.eye(6), 1.0, 0.0, valid)


def filled(history: FrameHistory, count: int, step: np.ndarray = STEP) -> list[Pose]:
    """Adds frames of a constant motion, in keyframe 0, without odometry; their poses."""
    keyframe = history.keyframe_pose(0)
    poses = []
    for _ in range(count):
        relative = exp(len(history) * step)
        poses.append(keyframe @ relative)
        history.add(len(history) * PERIOD_NS, poses[-1], 0, relative, None)
    return poses


@pytest.fixture
def history() -> FrameHistory:
    history = FrameHistory()
    history.keyframes = KeyframePoses(store(START))
    return history


def test_poses_follow_their_keyframe_and_online_poses_do_not():
    second = START @ exp(np.array([0.5, 0.0, 0.0, 0.0, 0.3, 0.0]))
    keyframes = store(START, second)
    history = FrameHistory()
    history.keyframes = KeyframePoses(keyframes)
    relatives = [exp(STEP), exp(-STEP)]
    online = [START @ relatives[0], second @ relatives[1]]
    for number in (0, 1):
        history.add(number * PERIOD_NS, online[number], number, relatives[number], None)
    np.testing.assert_allclose(history.trajectory().poses, online, atol=1e-6)

    moved = second @ exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.2]))
    keyframes.set_pose(1, moved)
    # What was taken before does not change with the store.
    np.testing.assert_allclose(history.pose(1), online[1], atol=1e-6)
    history.keyframes = KeyframePoses(keyframes)
    np.testing.assert_allclose(history.pose(0), online[0], atol=1e-6)
    np.testing.assert_allclose(history.pose(-1), moved @ relatives[1], atol=1e-6)
    np.testing.assert_allclose(
        history.trajectory().poses, [online[0], moved @ relatives[1]], atol=1e-6
    )
    np.testing.assert_array_equal(history.online_trajectory().poses, online)
    np.testing.assert_array_equal(history.trajectory().stamps_ns, [0, PERIOD_NS])
    assert history.newest_keyframe == 1


def test_a_constant_motion_is_continued(history):
    filled(history, 2)
    for periods in (0.5, 1.0, 2.0):
        expected = START @ exp((1.0 + periods) * STEP)
        found = history.extrapolated(round((1.0 + periods) * PERIOD_NS))
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_motion_is_not_continued_without_bound(history):
    poses = filled(history, 2)
    farthest = history.extrapolated(round((1.0 + MAX_EXTRAPOLATION) * PERIOD_NS))
    np.testing.assert_array_equal(history.extrapolated(1000 * PERIOD_NS), farthest)
    gone = np.linalg.norm(log(inverse(poses[-1]) @ farthest))
    assert gone == pytest.approx(MAX_EXTRAPOLATION * np.linalg.norm(STEP), rel=1e-3)


def test_a_single_frame_is_taken_to_stand_still(history):
    filled(history, 1)
    np.testing.assert_allclose(history.extrapolated(10 * PERIOD_NS), START, atol=1e-6)


def test_odometry_gives_the_motion_since_the_last_frame_that_had_it(history):
    before, now = exp(np.array([3.0, 2.0, 1.0, 0.3, 0.2, 0.1])), exp(-STEP)
    assert history.moved(estimate(now)) is None
    history.add(0, START, 0, np.eye(4), estimate(before))
    history.add(PERIOD_NS, START @ exp(STEP), 0, exp(STEP), None)
    moved = history.moved(estimate(now))
    assert moved is not None
    np.testing.assert_allclose(moved[0], START, atol=1e-6)
    np.testing.assert_allclose(moved[1], inverse(before) @ now, atol=1e-12)
    assert history.moved(None) is None
    assert history.moved(estimate(now, valid=False)) is None


def test_given_odometry_counts_from_its_last_valid_estimate(history):
    """A registration's chain goes on through a guess; given poses have nothing to do with it."""
    noise = MotionNoise(0.001, 0.001, 0.01)
    before, guess, now = (exp(number * STEP) for number in (1, 7, 3))
    for odometry in (estimate(before), estimate(guess, valid=False)):
        history.add(0, START, 0, np.eye(4), replace(odometry, noise=noise))
    moved = history.moved(replace(estimate(now), noise=noise))
    assert moved is not None
    np.testing.assert_allclose(moved[1], exp(2 * STEP), atol=1e-12)


def test_odometry_is_carried_over_a_short_gap_only(history):
    history.add(0, START, 0, np.eye(4), estimate(np.eye(4)))
    filled(history, MAX_ODOMETRY_GAP - 1)
    assert history.moved(estimate(np.eye(4))) is not None
    filled(history, 1)
    assert history.moved(estimate(np.eye(4))) is None


def test_a_path_that_was_broken_off_continues_no_motion_across_the_break(history):
    filled(history, 3)
    odometry = [estimate(exp(number * STEP)) for number in range(3)]
    history.add(3 * PERIOD_NS, START, 0, np.eye(4), odometry[0])
    history.break_off()
    found = START @ exp(np.array([5.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    assert history.moved(odometry[1]) is None
    relative = inverse(history.keyframe_pose(0)) @ found
    history.add(4 * PERIOD_NS, found, 0, relative, odometry[1])
    # One frame alone stands still; from there on odometry counts again.
    np.testing.assert_allclose(history.extrapolated(5 * PERIOD_NS), found, atol=1e-6)
    pose, motion = history.moved(odometry[2])
    np.testing.assert_allclose(pose, found, atol=1e-6)
    np.testing.assert_allclose(motion, exp(STEP), atol=1e-9)


def test_frames_of_a_lost_camera_are_not_in_the_known_trajectory(history):
    poses = filled(history, 2)
    history.add(2 * PERIOD_NS, poses[-1], 0, np.eye(4), None, known=False)
    history.add(3 * PERIOD_NS, poses[-1], 0, np.eye(4), None)
    np.testing.assert_array_equal(
        history.known_trajectory().stamps_ns, [0, PERIOD_NS, 3 * PERIOD_NS]
    )
    assert len(history.trajectory()) == 4


@pytest.mark.parametrize("count", [64, 65, 200])
def test_growth_keeps_everything(history, count):
    poses = filled(history, count, 0.1 * STEP)
    assert len(history) == count
    trajectory = history.trajectory()
    np.testing.assert_allclose(trajectory.poses, poses, atol=1e-5)
    np.testing.assert_array_equal(history.online_trajectory().poses, poses)
    np.testing.assert_array_equal(trajectory.stamps_ns, np.arange(count) * PERIOD_NS)


def test_no_frames_make_an_empty_trajectory():
    assert len(FrameHistory().trajectory().poses) == 0
    assert len(FrameHistory().online_trajectory().poses) == 0
