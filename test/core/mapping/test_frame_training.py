"""Which regions a frame trains, how long and how fast."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.mapping.frame_training import SETTLED_RATE_FACTOR, FrameTraining
from meslam_core.mapping.joint_optimizer import JointOptimizer, StepLosses
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.region import Region, RegionOrigin
from meslam_core.scratch import ScratchFile

CONFIG = MeslamConfig.from_overrides(
    ["keyframes.links=0", "field.backend=torch", "regions.mask_voxel_m=0.2"]
)
POSE = path(1)[0]


@dataclass(frozen=True)
class Trained:
    """A call of the optimiser."""

    region: RegionIndex
    steps: int
    refine_poses: bool
    rate_factor: float


class Frames:
    """Frames that are trained with, one after the other, by an optimiser that only notes it."""

    def __init__(self) -> None:
        scratch = ScratchFile()
        keyframes = KeyframeStore(64, torch.device("cpu"), scratch=scratch)
        self.atlas = RegionAtlas(CONFIG, np.zeros(3), keyframes, 0, scratch)
        generator = np.random.default_rng(0)
        rows, columns = generator.integers(0, 120, 64), generator.integers(0, 160, 64)
        self._rays = rays_at(frame_at(POSE), rows, columns)
        keyframes.add(0, POSE, self._rays)
        self.atlas.add_keyframe(0)
        self._trained: list[Trained] = []
        optimizer = JointOptimizer(keyframes, CONFIG.mapping)
        optimizer.train = self._train  # type: ignore[method-assign]
        self._training = FrameTraining(CONFIG, self.atlas, optimizer, scratch, lambda: False)

    def _train(
        self,
        region: Region,
        steps: int,
        current: Any,
        pose: Any,
        refine_poses: bool = True,
        rate_factor: float = 1.0,
        enough: Callable[[int], bool] = lambda done: False,
    ) -> StepLosses:
        self._trained.append(Trained(region.index, steps, refine_poses, rate_factor))
        return StepLosses(steps=steps)

    def at(self, *spacings: float) -> list[Trained]:
        """Train with a frame so many spacings of the lattice from the first; what was called."""
        self._trained.clear()
        pose = POSE.copy()
        pose[: len(spacings), 3] = self.atlas.grid.spacing_m * np.array(spacings)
        self.atlas.update(pose[:3, 3])
        self._training.start(0, self._rays, pose, None)
        self._training.wait()
        return list(self._trained)

    def close(self) -> None:
        self._training._worker.close()


@pytest.fixture
def frames() -> Iterator[Frames]:
    frames = Frames()
    yield frames
    frames.close()


def test_in_an_intersection_the_other_region_is_trained_half_as_long_without_poses(frames):
    steps = CONFIG.mapping.iterations
    assert frames.at(0.0) == [Trained((0, 0, 0), steps, True, 1.0)]
    assert frames.at(0.45) == [
        Trained((0, 0, 0), steps, True, 1.0),
        Trained((1, 0, 0), steps // 2, False, 1.0),
    ]


def test_a_region_that_worked_is_only_evened_out_beside_the_next_one(frames):
    frames.at(0.45)
    working, left = frames.at(0.55)
    assert (working.region, working.rate_factor) == ((1, 0, 0), 1.0)
    assert (left.region, left.rate_factor) == ((0, 0, 0), SETTLED_RATE_FACTOR)
    # Working again, it learns again.
    assert frames.at(0.4)[0] == Trained((0, 0, 0), CONFIG.mapping.iterations, True, 1.0)


def test_a_region_of_an_earlier_session_is_only_evened_out_too(frames):
    frames.at(0.45)
    frames.atlas.regions[(1, 0, 0)].origin = RegionOrigin(0, b"")
    assert frames.at(0.45)[1].rate_factor == SETTLED_RATE_FACTOR


def test_at_a_corner_the_others_take_turns(frames):
    frames.at(0.45, 0.45)
    turns = [frames.at(0.45, 0.45) for _ in range(6)]
    assert {len(turn) for turn in turns} == {2}
    others = [turn[1].region for turn in turns]
    assert sorted(others[:3]) == [(0, 1, 0), (1, 0, 0), (1, 1, 0)]
    assert others[3:] == others[:3]
