"""Poses from measured motions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from meslam_core.loop.pose_graph import optimised_poses, rigid_motion
from meslam_core.mapping.keyframe_links import KeyframeLinks, MeasuredMotion
from meslam_core.se3 import exp, inverse, log

COUNT = 120
STEP = exp(np.array([0.1, 0.0, 0.01, 0.0, 0.0, 2 * np.pi / COUNT]))
DRIFT = exp(np.array([0.001, -0.0005, 0.0005, 0.0003, 0.0, 0.0008]))


def circle() -> np.ndarray:
    poses = [np.eye(4)]
    for _ in range(COUNT - 1):
        poses.append(poses[-1] @ STEP)
    return np.array(poses)


def drifted() -> tuple[np.ndarray, KeyframeLinks]:
    """The circle as odometry with a bias has it, and its measurements."""
    poses, links = [np.eye(4)], KeyframeLinks()
    for number in range(1, COUNT):
        poses.append(poses[-1] @ STEP @ DRIFT)
        links.add(number - 1, number, STEP @ DRIFT, 1.0)
        if number > 1:
            links.add(number - 2, number, inverse(poses[-3]) @ poses[-1], 1.0)
    return np.array(poses), links


def seen_again(true: np.ndarray, *pairs: tuple[int, int]) -> list[MeasuredMotion]:
    return [MeasuredMotion(i, j, inverse(true[i]) @ true[j]) for i, j in pairs]


def errors(poses: np.ndarray) -> np.ndarray:
    return np.linalg.norm(poses[:, :3, 3] - circle()[:, :3, 3], axis=1)


def test_a_place_seen_again_corrects_the_whole_path():
    poses, links = drifted()
    assert errors(poses)[-1] > 0.15
    corrected = optimised_poses(poses, links, seen_again(circle(), (0, COUNT - 1), (2, COUNT - 2)))
    assert errors(corrected)[-1] < 0.005
    assert errors(corrected).max() < 0.3 * errors(poses).max()
    # The correction is spread: no step of the path jumps.
    for before, after in pairwise(corrected):
        assert np.abs(log(inverse(STEP @ DRIFT) @ inverse(before) @ after)).max() < 0.006
    assert np.allclose(corrected[0], np.eye(4))
    rotations = corrected[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-9
    )


def test_poses_that_agree_with_everything_stay():
    poses, links = drifted()
    np.testing.assert_allclose(optimised_poses(poses, links, []), poses, atol=1e-6)


def test_a_wrong_link_lets_go_and_a_recognised_place_does_not():
    poses, links = drifted()
    links.add(10, 60, exp(np.array([3.0, 0.0, 0.0, 0.0, 0.0, 1.0])), 1.0)
    np.testing.assert_allclose(optimised_poses(poses, links, []), poses, atol=2e-3)


def test_keyframes_that_nothing_measured_keep_their_motion():
    poses, _ = drifted()
    alone = KeyframeLinks()
    for number in range(1, COUNT):
        if number != 40:
            alone.add(number - 1, number, STEP @ DRIFT, 1.0)
    corrected = optimised_poses(poses, alone, [])
    np.testing.assert_allclose(corrected, poses, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_the_rigid_motion_between_poses_is_found(count):
    motion = exp(np.array([0.3, -0.2, 0.1, 0.05, -0.4, 0.2]))
    before = circle()[:count]
    np.testing.assert_allclose(rigid_motion(before, motion @ before), motion, atol=1e-9)
