"""Keyframes and the odometry between them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meslam_core.mapping.keyframe_chain import KeyframeChain
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import exp, inverse

RAYS = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1), torch.zeros(1, 3))
POSES = [exp(0.1 * number * np.arange(6.0)) for number in range(3)]


@pytest.fixture
def store() -> KeyframeStore:
    return KeyframeStore(1, torch.device("cpu"))


def estimate(number: int, valid: bool = True) -> OdometryEstimate:
    return OdometryEstimate(number, POSES[number], np.eye(6), 1.0, 0.0, valid)


def test_keyframes_are_tied_by_the_motion_between_them(store):
    chain = KeyframeChain(store)
    drift = exp(np.full(6, 0.2))
    for number in range(3):
        chain.pass_by(estimate(number))
        assert chain.add(number, drift @ POSES[number], RAYS, estimate(number)) == number
    links = store.links.all()
    np.testing.assert_array_equal(links.ends, [[0, 1], [1, 2]])
    for (i, j), rotation, translation in zip(
        links.ends, links.rotations, links.translations, strict=True
    ):
        motion = inverse(POSES[i]) @ POSES[j]
        np.testing.assert_allclose(rotation, motion[:3, :3], atol=1e-6)
        np.testing.assert_allclose(translation, motion[:3, 3], atol=1e-6)


def test_odometry_that_failed_between_two_keyframes_does_not_tie_them(store):
    chain = KeyframeChain(store)
    chain.add(0, POSES[0], RAYS, estimate(0))
    chain.pass_by(estimate(1, valid=False))
    chain.pass_by(estimate(2))
    chain.add(2, POSES[2], RAYS, estimate(2))
    assert len(store.links) == 0


def test_frames_without_odometry_break_no_chain_but_keyframes_without_do(store):
    chain = KeyframeChain(store)
    chain.add(0, POSES[0], RAYS, estimate(0))
    chain.pass_by(None)
    chain.add(1, POSES[1], RAYS, estimate(1))
    chain.add(2, POSES[2], RAYS, None)
    chain.add(3, POSES[2], RAYS, estimate(2))
    np.testing.assert_array_equal(store.links.all().ends, [[0, 1]])


def test_a_chain_that_was_cut_ties_the_next_keyframe_to_none(store):
    chain = KeyframeChain(store)
    chain.add(0, POSES[0], RAYS, estimate(0))
    chain.cut()
    chain.add(1, POSES[1], RAYS, estimate(1))
    chain.add(2, POSES[2], RAYS, estimate(2))
    np.testing.assert_array_equal(store.links.all().ends, [[1, 2]])
