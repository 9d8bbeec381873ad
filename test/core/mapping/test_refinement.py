"""Whose turn it is in a refinement, for how long and how fast."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from data.textured_room import path

from meslam_core.config import MeslamConfig
from meslam_core.mapping.joint_optimizer import JointOptimizer, StepLosses
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.refinement import (
    LAST_RATE_FACTOR,
    REFINING_STEPS,
    TURN_STEPS,
    Refinement,
)
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region, RegionOrigin

CONFIG = MeslamConfig.from_overrides(["field.backend=torch", "mapping.final_iterations=300"])
RAYS = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1), torch.zeros(1, 3))


@dataclass
class Refined:
    """A refinement, its regions, and what it had trained: region, steps, rate factor."""

    refinement: Refinement
    regions: list[Region]
    trained: list[tuple[tuple[int, int, int], int, float]] = field(default_factory=list)


@pytest.fixture
def refined(monkeypatch: pytest.MonkeyPatch) -> Refined:
    """Four regions about a corner, the first with three keyframes of six."""
    keyframes = KeyframeStore(1, torch.device("cpu"))
    atlas = RegionAtlas(CONFIG, np.zeros(3), keyframes, seed=0)
    for pose in path(6):
        keyframes.add(0, pose, RAYS)
    atlas.working.keyframes = [0]
    edge = 0.45 * atlas.grid.spacing_m
    atlas.update(np.array([edge, edge, 0.0]))
    regions = list(atlas.regions.values())
    for region, count in zip(regions, (3, 1, 1, 1), strict=True):
        region.keyframes = list(range(count))
        region.seen = len(keyframes)
    optimizer = JointOptimizer(keyframes, CONFIG.mapping, seed=0)
    refined = Refined(Refinement(atlas, optimizer), regions)

    def train(region: Region, steps: int, rate_factor: float) -> StepLosses:
        refined.trained.append((region.index, steps, rate_factor))
        return StepLosses(steps=steps)

    monkeypatch.setattr(optimizer, "train", train)
    return refined


def test_regions_take_turns_in_proportion_to_their_keyframes(refined):
    for _ in range(4 * TURN_STEPS // REFINING_STEPS):
        refined.refinement.train(REFINING_STEPS)
    order = list(dict.fromkeys(index for index, _, _ in refined.trained))
    assert order == [region.index for region in refined.regions]
    steps = [
        sum(steps for index, steps, _ in refined.trained if index == region.index)
        for region in refined.regions
    ]
    np.testing.assert_allclose(steps, 4 * TURN_STEPS * np.array([3, 1, 1, 1]) / 6, atol=2)
    assert all(region.version > 0 for region in refined.regions)


def test_the_rate_falls_with_progress(refined):
    for progress in (0.0, 0.5, 1.0):
        refined.refinement.train(1, progress)
    rates = [rate for _, _, rate in refined.trained]
    np.testing.assert_allclose(rates, [1.0, 0.5 * (1 + LAST_RATE_FACTOR), LAST_RATE_FACTOR])


def test_many_regions_take_longer_but_not_in_proportion(refined):
    assert refined.refinement.steps == 2 * CONFIG.mapping.final_iterations


def test_regions_that_an_earlier_session_left_stay_as_they_are(refined):
    for region in refined.regions[1:]:
        region.origin = RegionOrigin(region.version, b"")
    assert refined.refinement.steps == CONFIG.mapping.final_iterations
    refined.refinement.train(200)
    refined.refinement.rebuild_masks()
    assert {index for index, _, _ in refined.trained} == {refined.regions[0].index}
    assert all(region.untouched for region in refined.regions[1:])
    refined.regions[0].origin = RegionOrigin(refined.regions[0].version, b"")
    refined.trained.clear()
    refined.refinement.train(200)
    assert refined.trained == []
