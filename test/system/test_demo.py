"""`make demo`: the real nodes on a recording of a real camera, and what it leaves behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from data.memory_recording import MemoryRecording

from meslam_core.map.store import MapStore
from meslam_core.recordings import convert, open_recording
from meslam_core.trajectory import read_tum

DEMO = Path(__file__).resolve().parents[2] / "tools" / "demo.py"
FRAMES = 60
TIMEOUT_S = 280


def run_demo(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(DEMO), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Results and output of a demo on four seconds of a desk, as mcap."""
    data = os.environ.get("MESLAM_DATA")
    if not data:
        pytest.skip("MESLAM_DATA names no folder of real recordings")
    source = Path(data, "tum_fr1_xyz")
    if not source.is_dir():
        pytest.skip(f"{source} is not there")
    folder = tmp_path_factory.mktemp("desk")
    recording = folder / "desk.mcap"
    convert(MemoryRecording(list(islice(open_recording(source).frames(), FRAMES))), recording)
    truth = source / "groundtruth.txt"
    done = run_demo(recording, "--truth", truth, "--out", folder / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "out", done.stdout


def report(out: Path) -> dict[str, Any]:
    return json.loads((out / "report.json").read_text())


def test_real_recording_is_tracked(desk: tuple[Path, str]) -> None:
    out, _ = desk
    figures = report(out)
    assert figures["frames"] == FRAMES
    assert figures["frames_dropped"] == 0
    assert figures["frames_tracked"] >= 0.98 * FRAMES
    assert figures["ate_online_rmse_m"] < 0.04
    assert figures["ate_rmse_m"] < 0.04
    for name in ("trajectory.txt", "trajectory_online.txt"):
        assert len(read_tum(out / name)) >= 0.98 * FRAMES


def test_map_and_mesh_are_whole(desk: tuple[Path, str]) -> None:
    out, _ = desk
    loaded = MapStore(out / "map.meslam").load()
    assert not loaded.warnings
    assert len(loaded.regions) == report(out)["regions"]
    mesh = o3d.io.read_triangle_mesh(str(out / "mesh.ply"))
    assert 3.0 < mesh.get_surface_area() < 60.0
    assert np.ptp(np.asarray(mesh.vertex_colors), axis=0).min() > 0.3


def test_people_get_pictures_and_a_summary(desk: tuple[Path, str]) -> None:
    out, output = desk
    for name in ("path.png", "error.png", "views.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert "frames with a pose" in output
    assert "ATE RMSE" in output
    assert "live in the browser: http://127.0.0.1:" in output.replace("\n", "")
    page = (out / "report.html").read_text()
    for part in ("path", "map", "tracking", "time", "growth"):
        assert f'<section id="{part}">' in page
    assert str(out / "report.html") in output
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_unreadable_recording_is_named(tmp_path: Path) -> None:
    done = run_demo(tmp_path / "nothing.mcap", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "nothing.mcap" in done.stdout.replace("\n", "")
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
