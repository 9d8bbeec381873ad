"""Adam on poses, with links alone: no map pulls here."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from meslam_core.config import MappingConfig
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.pose_refinement import PoseRefinement
from meslam_core.se3 import Pose, exp, inverse, log

CONFIG = MappingConfig(odometry_weight=50.0)
DISTURBANCE = exp(np.array([0.01, -0.008, 0.012, 0.01, -0.006, 0.008]))


def store_of(poses: list[Pose]) -> KeyframeStore:
    store = KeyframeStore(1, torch.device("cpu"))
    ray = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1), torch.zeros(1, 3))
    for number, pose in enumerate(poses):
        store.add(number, pose, ray)
    return store


def refined(store: KeyframeStore, numbers: list[int], steps: int, config=CONFIG) -> None:
    """Let the links alone move some keyframes."""
    block = PoseRefinement(store, config).start(np.array(numbers), None, np.random.default_rng(0))
    for _ in range(steps):
        block.move(np.zeros((len(block.rotations), 6), np.float32))
    block.finish()


def errors(store: KeyframeStore, poses: list[Pose]) -> np.ndarray:
    return np.array([np.abs(log(inverse(p) @ store.pose(n))).max() for n, p in enumerate(poses)])


def chain(count: int) -> list[Pose]:
    return [
        exp(0.2 * number * np.array([1.0, 0.3, -0.2, 0.2, 0.5, -0.4])) for number in range(count)
    ]


def test_links_bring_a_keyframe_back_between_its_neighbours():
    poses = chain(5)
    store = store_of(poses)
    for number in range(4):
        store.add_link(number, number + 1, inverse(poses[number]) @ poses[number + 1])
    store.set_pose(2, DISTURBANCE @ poses[2])
    assert errors(store, poses)[2] > 0.01
    refined(store, [2], 300)
    assert errors(store, poses).max() < 0.002


def test_a_link_across_closes_the_loop():
    poses = chain(6)
    store = store_of(poses)
    store.set_pose(5, DISTURBANCE @ poses[5])
    store.add_link(5, 0, inverse(poses[5]) @ poses[0])
    refined(store, list(range(6)), 300)
    assert errors(store, poses).max() < 0.002


def test_the_first_keyframe_and_those_not_named_never_move():
    poses = chain(4)
    store = store_of(poses)
    before = [store.pose(number) for number in range(4)]
    for number in range(3):
        store.add_link(number, number + 1, DISTURBANCE)
    refined(store, [0, 2], 50)
    for number in (0, 1, 3):
        np.testing.assert_array_equal(store.pose(number), before[number])
    assert np.abs(store.pose(2) - before[2]).max() > 1e-3


def test_the_pose_of_the_current_frame_stands_last():
    poses = chain(3)
    store = store_of(poses)
    store.add_link(0, 1, np.eye(4))
    current = exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    block = PoseRefinement(store, CONFIG).start(np.array([1]), current, np.random.default_rng(0))
    assert block.rotations.shape == (3, 3, 3)
    for _ in range(10):
        block.move(np.ones((3, 6), np.float32))
    np.testing.assert_allclose(block.rotations[-1], current[:3, :3], atol=1e-6)
    np.testing.assert_allclose(block.translations[-1], current[:3, 3], atol=1e-6)
    np.testing.assert_allclose(block.translations[1], poses[0][:3, 3], atol=1e-6)


def test_a_gradient_that_is_not_finite_moves_nothing():
    poses = chain(3)
    store = store_of(poses)
    refinement = PoseRefinement(store, CONFIG)
    block = refinement.start(np.array([1, 2]), None, np.random.default_rng(0))
    gradient = np.ones((2, 6), np.float32)
    gradient[1, 3] = np.nan
    block.move(gradient)
    block.finish()
    assert errors(store, poses).max() < 1e-6
    assert refinement.steps == 0


def test_poses_follow_adam():
    """Against torch's Adam on the same gradients, where turns are small enough to add."""
    store = store_of([np.eye(4)] * 3)
    config = dataclasses.replace(CONFIG, pose_decay_steps=1e9, pose_learning_rate=1e-4)
    refinement = PoseRefinement(store, config)
    twists = torch.zeros(2, 6, requires_grad=True)
    adam = torch.optim.Adam([twists], lr=1e-4, betas=(0.9, 0.99), eps=1e-8)
    generator = np.random.default_rng(0)
    # Two portions: what Adam remembers lasts from one to the next.
    for _ in range(2):
        block = refinement.start(np.array([1, 2]), None, generator)
        for _ in range(10):
            gradient = generator.normal(size=(2, 6)).astype(np.float32) + 0.5
            twists.grad = torch.from_numpy(gradient.copy())
            adam.step()
            block.move(gradient)
        block.finish()
    for number in (1, 2):
        twist = log(store.pose(number))
        np.testing.assert_allclose(twist, twists[number - 1].detach(), atol=2e-6)


def test_rotations_stay_orthonormal_over_many_steps():
    store = store_of(chain(4))
    block = PoseRefinement(store, CONFIG).start(np.arange(4), None, np.random.default_rng(0))
    generator = np.random.default_rng(1)
    for _ in range(64):
        block.move(generator.normal(size=(4, 6)).astype(np.float32))
    block.finish()
    rotations = store.pose_arrays()[0].astype(np.float64)
    gram = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (4, 1, 1)), atol=1e-6)
    assert (np.linalg.det(rotations) > 0).all()
