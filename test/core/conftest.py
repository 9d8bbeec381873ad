"""What the tests of the core share: fields that are trained once a session."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path
from hypothesis import settings

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.pipeline import RunOptions, RunOutcome, run
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose
from meslam_core.threads import limit_threads
from meslam_core.tracking.pixels import trusted_pixels
from meslam_core.trajectory import Trajectory, write_tum

settings.register_profile("deterministic", derandomize=True, deadline=None, database=None)
settings.load_profile("deterministic")
limit_threads(1)

TRAINING_STEPS = 700
# As a run's last refinement does: at the full rate the map trembles by millimetres.
FALLING_RATE = (0.5, 0.2, 0.05)


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


@dataclass(frozen=True)
class FinishedRun:
    """A run's folder, the truth it was compared with, and its outcome."""

    out: Path
    truth: Path
    outcome: RunOutcome


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
        for rate_factor in FALLING_RATE:
            optimizer.train(room.region, steps // 10, refine_poses=False, rate_factor=rate_factor)
        return room

    return build


@pytest.fixture(scope="session")
def mapped_room(build_room) -> MappedRoom:
    """A converged map; must not be changed."""
    return build_room(TRAINING_STEPS)


QUICK = (
    "keyframes.rays=2048",
    "mapping.first_iterations=150",
    "mapping.iterations=8",
    "mapping.keyframe_iterations=16",
    "mapping.final_iterations=60",
    "regions.mask_extent=2.0",
)
"""Overrides that make a run short and still accurate to centimetres in the textured room."""


@pytest.fixture(scope="session")
def quick_config() -> MeslamConfig:
    """A configuration for runs of a few frames."""
    return MeslamConfig.from_overrides(QUICK)


@pytest.fixture(scope="session")
def room_poses() -> list[Pose]:
    """True poses of `room_frames`; the first is where a map begins."""
    return path(16, step_m=0.02, step_deg=1.0)


@pytest.fixture(scope="session")
def room_frames(room_poses) -> list[RgbdFrame]:
    """A short walk through the textured room."""
    return [frame_at(pose, number) for number, pose in enumerate(room_poses)]


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory, quick_config, room_poses, room_frames) -> FinishedRun:
    """The results of a whole run; must not be changed."""
    folder = tmp_path_factory.mktemp("run")
    stamps = np.array([frame.stamp_ns for frame in room_frames])
    write_tum(folder / "truth.txt", Trajectory(stamps, np.array(room_poses)))
    outcome = run(
        MemoryRecording(room_frames),
        quick_config,
        folder / "out",
        RunOptions(truth=folder / "truth.txt"),
    )
    return FinishedRun(folder / "out", folder / "truth.txt", outcome)
