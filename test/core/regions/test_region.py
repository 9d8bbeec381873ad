"""Regions that rest."""

from __future__ import annotations

import os

import numpy as np
import pytest

from meslam_core.errors import OutputError
from meslam_core.map.stored_region import snapshot
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.scratch import ScratchFile

BACKENDS = ("kernel", "torch")


@pytest.fixture(params=BACKENDS)
def room(build_room, request):
    """A region that has learnt a little, with the optimiser in full swing."""
    return build_room(20, (f"field.backend={request.param}", "keyframes.rays=1024"))


def test_a_region_at_rest_is_on_disk_alone_and_still_answers_for_itself(room):
    region, scratch = room.region, ScratchFile()
    weights, flags = region.weights(), region.observed().flags.copy()
    region.rest(scratch, 5)
    assert region.at_rest
    for what in ("field", "mask"):
        with pytest.raises(AssertionError, match="at rest"):
            getattr(region, what)
    np.testing.assert_array_equal(region.weights(), weights)
    np.testing.assert_array_equal(region.observed().flags, flags)
    stored = snapshot(region, 5)
    np.testing.assert_array_equal(stored.parameters, weights)
    assert region.at_rest


def test_training_goes_on_after_a_rest_from_the_average_of_the_last_steps(build_room, room):
    overrides = (f"field.backend={room.config.field.backend}", "keyframes.rays=1024")
    rested, other = room, build_room(20, overrides)
    state = other.region.field.optimizer_state()
    other.region.field.load_flat(other.region.weights())
    other.region.field.load_optimizer_state(*state)
    rested.region.rest(ScratchFile(), 5)
    rested.region.wake()
    for each in (rested, other):
        optimizer = JointOptimizer(each.keyframes, each.config.mapping, seed=1)
        optimizer.train(each.region, 5, refine_poses=False)
    np.testing.assert_array_equal(rested.region.weights(), other.region.weights())
    np.testing.assert_array_equal(rested.region.mask.flags, other.region.mask.flags)
    assert rested.region.keyframes == other.region.keyframes


def test_resting_again_and_again_takes_no_more_disk(room):
    region, scratch = room.region, ScratchFile()
    region.rest(scratch, 5)
    size = scratch.size
    for _ in range(3):
        region.wake()
        region.rest(scratch, 5)
    assert scratch.size == size


def test_a_region_that_the_disk_does_not_take_stays_awake(room, monkeypatch):
    region, scratch = room.region, ScratchFile()
    weights = region.weights()

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OutputError, match="No space left"):
        region.rest(scratch, 5)
    assert not region.at_rest
    np.testing.assert_array_equal(region.field.average(), weights)
