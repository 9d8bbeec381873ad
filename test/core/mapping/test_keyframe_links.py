"""Measured motions between keyframes and their pull on the poses."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.mapping.keyframe_links import LINK_OUTLIER, KeyframeLinks
from meslam_core.se3 import Pose, exp, inverse, log

RNG = np.random.default_rng(0)


def random_poses(count: int, seed: int) -> list[Pose]:
    generator = np.random.default_rng(seed)
    return [exp(generator.normal(scale=0.7, size=6)) for _ in range(count)]


def arrays(poses: list[Pose]) -> tuple[np.ndarray, np.ndarray]:
    stacked = np.array(poses, np.float32)
    return stacked[:, :3, :3].copy(), stacked[:, :3, 3].copy()


def turned_about_centre(pose: Pose, twist: np.ndarray) -> Pose:
    moved = pose.copy()
    moved[:3, :3] = exp(np.concatenate([np.zeros(3), twist[3:]]))[:3, :3] @ pose[:3, :3]
    moved[:3, 3] += twist[:3]
    return moved


def cost(poses: list[Pose], links: list[tuple[int, int, Pose, float]]) -> float:
    """Half the sum of Geman-McClure costs of shift and turn."""
    total = 0.0
    for i, j, T_i_j, weight in links:
        predicted = poses[i] @ T_i_j
        shift = poses[j][:3, 3] - predicted[:3, 3]
        turn = log(poses[j] @ inverse(predicted))[3:]
        for squared in (shift @ shift, turn @ turn):
            total += 0.5 * weight * squared / (1.0 + squared / LINK_OUTLIER**2)
    return total


def test_the_gradient_is_that_of_the_cost():
    poses = random_poses(5, 1)
    noise = np.random.default_rng(2)
    ends = [(0, 1), (1, 2), (3, 1), (4, 0), (2, 4), (1, 0)]
    measured = [
        (i, j, inverse(poses[i]) @ poses[j] @ exp(noise.normal(scale=0.008, size=6)), weight)
        for (i, j), weight in zip(ends, [1.0, 0.5, 2.0, 1.0, 0.1, 3.0], strict=True)
    ]
    links = KeyframeLinks()
    for link in measured:
        links.add(*link)
    block = links.among(np.arange(5), 100, RNG)
    gradient = np.full((5, 6), 2.0, np.float32)
    block.add_gradient(*arrays(poses), 10.0, gradient)
    step = 1e-5
    for pose in range(5):
        for axis in range(6):
            twist = step * np.eye(6)[axis]
            sides = []
            for sign in (1.0, -1.0):
                moved = list(poses)
                moved[pose] = turned_about_centre(poses[pose], sign * twist)
                sides.append(cost(moved, measured))
            expected = 2.0 + 10.0 * (sides[0] - sides[1]) / (2 * step)
            assert gradient[pose, axis] == pytest.approx(expected, abs=2e-3)


def test_agreement_pulls_at_nothing():
    poses = random_poses(3, 4)
    links = KeyframeLinks()
    links.add(0, 2, inverse(poses[0]) @ poses[2], 1.0)
    gradient = np.zeros((3, 6), np.float32)
    links.among(np.arange(3), 10, RNG).add_gradient(*arrays(poses), 1.0, gradient)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)


def test_a_failure_lets_go():
    links = KeyframeLinks()
    pulls = []
    for shift in (0.01, 1.0):
        links = KeyframeLinks()
        T_0_1 = np.eye(4)
        T_0_1[0, 3] = shift
        links.add(0, 1, T_0_1, 1.0)
        gradient = np.zeros((2, 6), np.float32)
        links.among(np.arange(2), 10, RNG).add_gradient(
            *arrays([np.eye(4), np.eye(4)]), 1.0, gradient
        )
        pulls.append(abs(gradient[1, 0]))
    assert pulls[1] < 0.01 * pulls[0]


def test_only_links_that_touch_the_keyframes_count_and_their_far_ends_stand():
    poses = random_poses(40, 5)
    links = KeyframeLinks()
    # More than one growth of the arrays.
    for i in range(39):
        links.add(i, i + 1, np.eye(4), 1.0)
    links.add(30, 11, np.eye(4), 1.0)
    assert len(links) == 40
    block = links.among(np.array([10, 11]), 100, RNG)
    assert sorted(block.anchors.tolist()) == [9, 12, 30]
    assert len(block.ends) == 4
    gradient = np.zeros((2, 6), np.float32)
    numbers = [10, 11, *block.anchors]
    block.add_gradient(*arrays([poses[n] for n in numbers]), 1.0, gradient)
    whole = np.zeros((40, 6), np.float32)
    links.among(np.arange(40), 100, RNG).add_gradient(*arrays(poses), 1.0, whole)
    np.testing.assert_allclose(gradient, whole[10:12], rtol=1e-5, atol=1e-8)


def test_of_too_many_links_a_choice_weighs_as_much():
    links = KeyframeLinks()
    for _ in range(100):
        links.add(0, 1, np.eye(4), 2.0)
    block = links.among(np.array([0, 1]), 30, np.random.default_rng(0))
    assert len(block.ends) == 30
    assert block.weights.sum() == pytest.approx(200.0)


def test_keyframes_without_links():
    block = KeyframeLinks().among(np.array([0, 3]), 10, RNG)
    gradient = np.zeros((2, 6), np.float32)
    block.add_gradient(*arrays(random_poses(2, 0)), 1.0, gradient)
    assert not gradient.any()
    assert len(block.anchors) == 0
