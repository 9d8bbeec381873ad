"""What is shown of a finished run, without a browser."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from core.viewer.conftest import FRAMES
from typer.testing import CliRunner

from meslam_core.cli import app
from meslam_core.errors import MapError
from meslam_core.viewer.finished_run import FinishedRun
from meslam_core.viewer.scene import RegionState
from meslam_core.viewer.viewer import Viewer


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with closing(Viewer(port=0)) as viewer:
        yield viewer


def test_a_run_begins_at_its_first_pose(viewer: Viewer, run_folder: Path) -> None:
    run = FinishedRun(viewer, run_folder)
    scene = viewer.scene
    assert run.missing == []
    assert [box.state for box in scene.regions.value] == [RegionState.WORKING]
    assert len(scene.refined_path.value) == FRAMES
    assert len(scene.online_path.value) == 1
    view = scene.camera.value
    assert view is not None
    assert np.allclose(view.T_map_camera[:3, 3], [-1.2, -0.5, 0.0])
    assert view.aspect == pytest.approx(4 / 3)
    status = scene.status.value
    assert (status.state, status.frames_per_s, status.keyframes) == ("FINISHED", 12.5, 3)
    assert status.bytes_per_m3 == pytest.approx(status.map_bytes / 20.0)
    run.close()


def test_a_map_alone_is_shown(viewer: Viewer, run_folder: Path) -> None:
    run = FinishedRun(viewer, run_folder / "map.meslam")
    status = viewer.scene.status.value
    assert status.state == "STORED"
    assert 10_000 < status.map_bytes < 100_000
    assert status.observed_volume_m3 > 10.0
    run.close()


def test_a_run_without_its_recording_says_how_to_name_it(
    viewer: Viewer, run_folder: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(run_folder, moved)
    report = json.loads((moved / "report.json").read_text())
    (moved / "report.json").write_text(json.dumps(report | {"recording_path": "/nowhere/at.all"}))
    run = FinishedRun(viewer, moved)
    assert len(run.missing) == 1
    assert "--recording" in run.missing[0]
    run.close()


def test_a_run_whose_map_is_gone_is_refused(
    viewer: Viewer, run_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(run_folder, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "map.meslam")
    with pytest.raises(MapError, match="does not exist"):
        FinishedRun(viewer, tmp_path / "run")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["nothing"], "nothing"), (["nothing", "--host", "192.0.2.1"], "cannot listen")],
)
def test_the_command_says_what_is_wrong(arguments: list[str], word: str) -> None:
    result = CliRunner().invoke(app, ["view", "--port", "0", *arguments])
    assert result.exit_code == 2
    assert word in result.stderr
