"""Short runs on real recordings; the folder that MESLAM_DATA names holds them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.pipeline import RunOptions, run
from meslam_core.recordings import open_recording
from meslam_core.trajectory import read_tum

DATA = Path(os.environ.get("MESLAM_DATA", "/nonexistent"))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not DATA.is_dir(), reason="needs the recordings in the folder MESLAM_DATA names"
    ),
]


def run_on(name: str, out: Path, frames: int, truth: str | None = None) -> dict:
    """The report of a run on the first frames of a recording."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"MESLAM_DATA has no {name}")
    config = MeslamConfig.from_overrides(["mapping.final_iterations=200"])
    recording = open_recording(path)
    try:
        options = RunOptions(frames=slice(0, frames), truth=path / truth if truth else None)
        return run(recording, config, out, options).report
    finally:
        recording.close()


@pytest.mark.parametrize(
    ("name", "truth", "limit_m"),
    [
        ("tum_fr1_xyz", "groundtruth.txt", 0.025),
        ("livingroom", "reference_poses.txt", 0.03),
    ],
)
def test_every_frame_is_tracked_near_the_truth(tmp_path, name, truth, limit_m):
    report = run_on(name, tmp_path, 40, truth)
    assert report["frames_tracked"] == 40
    assert report["ate_rmse_m"] < limit_m
    assert report["ate_online_rmse_m"] < 1.3 * limit_m


def test_sparse_depth_of_a_d435_is_tracked(tmp_path):
    report = run_on("d435_desk", tmp_path, 30)
    assert report["frames_tracked"] >= 29


def test_both_forms_of_a_librealsense_recording_give_the_same_trajectory(tmp_path):
    for name in ("d435_sdk2.55.bag", "d435_sdk2.59.db3"):
        report = run_on(f"realsense_recordings/{name}", tmp_path / name, 8)
        assert report["frames_tracked"] == 8
    trajectories = [
        read_tum(tmp_path / name / "trajectory.txt")
        for name in ("d435_sdk2.55.bag", "d435_sdk2.59.db3")
    ]
    assert absolute_error(*trajectories).rmse_m < 0.01
