"""What the tests of the core share: fields that are trained once a session."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path
from hypothesis import settings

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose
from meslam_core.tracking.pixels import trusted_pixels

settings.register_profile("deterministic", derandomize=True, deadline=None, database=None)
settings.load_profile("deterministic")
# Two threads that wait for each other on a busy machine are many times slower than one.
torch.set_num_threads(1)

TRAINING_STEPS = 700


@dataclass
class MappedRoom:
    """A region that learnt the textured room from keyframes at their true poses.

    Attributes:
        poses: true T_map_camera along a path; `mapped` are the numbers of the keyframes' poses.
    """

    config: MeslamConfig
    poses: list[Pose]
    mapped: list[int]
    keyframes: KeyframeStore
    atlas: RegionAtlas
    frames: dict[int, RgbdFrame] = field(default_factory=dict)

    @property
    def region(self) -> Region:
        """The only region."""
        return self.atlas.working

    def frame(self, number: int) -> RgbdFrame:
        """The exact view from pose `number`."""
        if number not in self.frames:
            self.frames[number] = frame_at(self.poses[number], number)
        return self.frames[number]


@pytest.fixture(scope="session")
def build_room():
    """Builds a `MappedRoom`; for tests that change what they are given."""

    def build(steps: int, overrides: tuple[str, ...] = ()) -> MappedRoom:
        config = MeslamConfig.from_overrides(["keyframes.rays=4096", *overrides])
        poses = path(41)
        mapped = [0, 10, 20, 30, 40]
        keyframes = KeyframeStore(config.keyframes.rays, torch.device("cpu"))
        atlas = RegionAtlas(config, poses[0][:3, 3], keyframes, seed=0)
        room = MappedRoom(config, poses, mapped, keyframes, atlas)
        generator = np.random.default_rng(0)
        for number in mapped:
            frame = room.frame(number)
            rows, columns = np.nonzero(trusted_pixels(frame.depth_m, config.sensor))
            chosen = generator.choice(len(rows), config.keyframes.rays, replace=True)
            rays = rays_at(frame, rows[chosen], columns[chosen])
            atlas.add_keyframe(keyframes.add(frame.stamp_ns, poses[number], rays))
        optimizer = JointOptimizer(keyframes, config.mapping, seed=0)
        optimizer.train(room.region, steps, refine_poses=False)
        return room

    return build


@pytest.fixture(scope="session")
def mapped_room(build_room) -> MappedRoom:
    """A converged map; must not be changed."""
    return build_room(TRAINING_STEPS)
