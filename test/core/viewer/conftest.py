"""A stored map and a finished run for the viewer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored
from data.image_folders import write_folder
from data.synthetic_frames import CAMERA

from meslam_core.frame import RgbdFrame
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.trajectory import Trajectory, write_tum

FRAMES = 12
SECOND_NS = 1_000_000_000
IMAGE_COLORS = ((200, 40, 200), (40, 200, 200))
"""Of the recording's first and second half."""


@pytest.fixture(scope="session")
def region() -> StoredRegion:
    """A red ball in a room."""
    return stored(learnt_field(), SphereInRoom())


@pytest.fixture(scope="session")
def run_folder(region: StoredRegion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `meslam run` leaves behind: a camera that looks at the ball and moves along y."""
    folder = tmp_path_factory.mktemp("run")
    stamps_ns = np.arange(FRAMES) * SECOND_NS // 4 + SECOND_NS
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    poses[:, :3, 3] = [[-1.2, 0.08 * n - 0.5, 0.0] for n in range(FRAMES)]
    MapStore(folder / "map.meslam").save([region], GRID)
    trajectory = Trajectory(stamps_ns, poses)
    write_tum(folder / "trajectory.txt", trajectory)
    write_tum(folder / "trajectory_online.txt", trajectory)
    depth_m = np.ones((CAMERA.height, CAMERA.width), np.float32)
    images = [
        RgbdFrame(
            int(stamp),
            np.full((*depth_m.shape, 3), IMAGE_COLORS[number >= FRAMES // 2], np.uint8),
            depth_m,
            CAMERA,
        )
        for number, stamp in enumerate(stamps_ns)
    ]
    write_folder(folder / "recording", images)
    report = {
        "frames": FRAMES,
        "frames_tracked": FRAMES,
        "fps": 12.5,
        "observed_volume_m3": 20.0,
        "keyframes": 3,
        "recording_path": str(folder / "recording"),
        "camera": CAMERA.to_dict(),
    }
    (folder / "report.json").write_text(json.dumps(report))
    return folder
