"""The evaluation: which recordings it finds, evo beside our own errors, cells, and the document."""

from __future__ import annotations

import json
import sys
import time
from argparse import Namespace
from pathlib import Path

import evaluation
import evaluation_cell
import machine
import numpy as np
import pytest
from data.image_folders import write_image, write_tum
from data.textured_room import CAMERA, frame_at, path
from evaluated_recordings import SCENES, Source, recorded, simulations, tum_origin
from evaluation_cell import CELL, DISAGREES
from evaluation_document import write_document
from evo_check import DisagreementError, check_agreement, evo_rmse
from paper_tables import sequence_of
from peers.peer import PeerRun
from rich.console import Console
from slam_run import Sequence

from meslam_core import trajectory
from meslam_core.evaluation.trajectory_error import absolute_error, relative_error_by_frames
from meslam_core.se3 import exp
from meslam_core.trajectory import Trajectory

FRAMES = 8


@pytest.fixture
def data(tmp_path) -> Path:
    """A folder with a TUM sequence, one without truth, and a folder of images with poses."""
    poses = path(FRAMES, step_m=0.03)
    frames = [frame_at(pose, number) for number, pose in enumerate(poses)]
    truth = Trajectory(np.array([frame.stamp_ns for frame in frames]), np.array(poses))
    for name in ("rgbd_dataset_freiburg1_desk", "rgbd_dataset_freiburg2_rpy"):
        write_tum(tmp_path / name, frames)
        (tmp_path / name / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    trajectory.write_tum(tmp_path / "rgbd_dataset_freiburg1_desk" / "groundtruth.txt", truth)
    folder = tmp_path / "another_room"
    for number, frame in enumerate(frames):
        write_image(folder / "color" / f"{number}.png", frame.color)
    (folder / "camera.json").write_text("{}")
    trajectory.write_tum(folder / "t265_poses.txt", truth)
    return tmp_path


def desk(data: Path) -> Sequence:
    return next(source.sequence for source in recorded(data))


def wavering(truth: Trajectory, seed: int = 0) -> Trajectory:
    """A trajectory that is off by millimetres, in a frame of its own."""
    twists = 0.004 * np.random.default_rng(seed).standard_normal((len(truth), 6))
    poses = np.array([pose @ exp(twist) for pose, twist in zip(truth.poses, twists, strict=True)])
    return Trajectory(truth.stamps_ns, exp(np.array([0.3, -1.0, 2.0, 0.1, 1.2, -0.4])) @ poses)


def test_recordings_with_truth_are_found_the_benchmarks_sequences_first(data):
    found = [source.sequence for source in recorded(data)]
    assert [each.name for each in found] == ["rgbd_dataset_freiburg1_desk", "another_room"]
    assert [each.lever_arm for each in found] == [False, True]


def test_every_scene_is_simulated_where_it_is_missing(tmp_path):
    found = simulations(tmp_path)
    assert [source.scene for source in found] == list(SCENES)
    assert not any(source.there for source in found)
    assert all(source.sequence.surface for source in found)


def test_a_thinned_sequence_is_said_to_be_thinned(data):
    folder = data / "rgbd_dataset_freiburg1_desk"
    told = tum_origin(desk(data))
    assert f"{FRAMES} pairs" in told
    assert "15 of the camera's 30 frames" in told
    assert "JPEG" not in told
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text().replace(".png", ".jpg"))
    assert "colour as JPEG" in tum_origin(desk(data))


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("rgbd_dataset_freiburg1_desk", "fr1/desk"),
        ("tum_fr2_xyz", "fr2/xyz"),
        ("rgbd_dataset_freiburg3_long_office_household", "fr3/office"),
        ("rgbd_dataset_freiburg1_desk2", ""),
        ("tum_fr1_xyz", ""),
        ("livingroom", ""),
    ],
)
def test_the_papers_sequences_are_known_by_their_folders(folder, name):
    assert sequence_of(folder) == name


def test_evo_says_what_we_say(data, tmp_path):
    truth = trajectory.read_tum(desk(data).truth)
    estimate = wavering(truth)
    trajectory.write_tum(tmp_path / "estimate.txt", estimate)
    files = (tmp_path / "estimate.txt", desk(data).truth)
    assert absolute_error(estimate, truth).rmse_m == pytest.approx(evo_rmse(*files), abs=1e-8)
    steps = relative_error_by_frames(estimate, truth).trans_rmse_m
    assert steps == pytest.approx(evo_rmse(*files, relative=True), abs=1e-8)


def test_evo_has_no_answer_to_a_camera_that_never_moved(data, tmp_path):
    truth = trajectory.read_tum(desk(data).truth)
    still = Trajectory(truth.stamps_ns, np.tile(np.eye(4), (len(truth), 1, 1)))
    trajectory.write_tum(tmp_path / "still.txt", still)
    assert evo_rmse(tmp_path / "still.txt", desk(data).truth) is None


def test_a_micrometre_is_a_disagreement():
    check_agreement("path", 0.010, 0.0100009)
    check_agreement("path", 0.010, None)
    for other in (0.010002, float("nan")):
        with pytest.raises(DisagreementError, match="path"):
            check_agreement("path", 0.010, other)


@pytest.fixture
def cell_of(data, monkeypatch, tmp_path):
    """Judges a peer whose trajectory is known, as the program would; its folder."""
    sequence = desk(data)
    truth = trajectory.read_tum(sequence.truth)

    def run(job) -> None:
        PeerRun(wavering(truth, 1), wavering(truth), FRAMES, 0.5).write(job.out, {})

    def judge() -> Path:
        monkeypatch.setattr(
            evaluation_cell,
            "run_and_watch",
            lambda job: run(job) or {"load_average": 0.1, "others_cores": 0.0},
        )
        out = tmp_path / "cells" / "tsdf_0"
        command = ["evaluation_cell.py", sequence.name, str(sequence.recording)]
        command += [str(sequence.truth), "tsdf", "--out", str(out)]
        monkeypatch.setattr(sys, "argv", command)
        evaluation_cell.main()
        return out

    return judge


def test_a_cell_holds_the_errors_of_both(cell_of):
    cell = json.loads((cell_of() / CELL).read_text())
    for name, evo in cell["evo"].items():
        assert cell[name] == pytest.approx(evo, abs=1e-8)
    assert cell["frames_tracked"] == cell["frames_offered"] == FRAMES
    assert 0.001 < cell["ate_m"] < 0.02
    assert cell["map_bytes"] > 0


def test_a_cell_in_which_evo_disagrees_is_not_done(cell_of, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(evaluation_cell, "evo_rmse", lambda *_, **__: 0.5)
    with pytest.raises(SystemExit) as ended:
        cell_of()
    assert ended.value.code == DISAGREES
    assert "evo 500." in capsys.readouterr().err
    assert not list(tmp_path.glob(f"cells/**/{CELL}"))


def test_what_others_compute_is_told(data, monkeypatch, tmp_path):
    """The machine was busy for a second, and the run itself slept."""
    job = evaluation.SlamRun(desk(data), "tsdf", 0, ":", 1, tmp_path / "cell")
    command = [sys.executable, "-c", "import time; print('hello'); time.sleep(0.2)"]
    monkeypatch.setattr(evaluation.SlamRun, "command", command)
    busy_s = iter((10.0, 11.0))
    monkeypatch.setattr(evaluation_cell, "busy_core_s", lambda: next(busy_s))
    started = time.perf_counter()
    told = evaluation_cell.run_and_watch(job)
    longest_s = time.perf_counter() - started
    assert 0.8 / longest_s < told["others_cores"] < 1.0 / 0.2
    assert told["load_average"] >= 0.0
    assert "hello" in (tmp_path / f"cell.{evaluation_cell.LOG}").read_text()


def test_the_machine_has_computed_something():
    assert machine.busy_core_s() > 0.0


def test_the_page_is_of_our_first_seeds(data, monkeypatch, tmp_path):
    asked: list[list[str]] = []
    monkeypatch.setattr(evaluation.subprocess, "run", lambda command, **_: asked.append(command))
    options = Namespace(
        seeds=2,
        other_seeds=1,
        methods=["meslam", "tsdf"],
        frames=":",
        large_frames=":",
        cores=1,
    )
    monkeypatch.setattr(evaluation, "CACHE", tmp_path / "cells")
    cells = evaluation.cells_of([Source(desk(data), "a desk")], options)
    for cell in cells:
        cell.path.parent.mkdir(parents=True)
        cell.path.write_text("{}")
    evaluation.write_page(cells, tmp_path / "page.html")
    assert asked[0][1:3] == ["report", str(cells[0].job.out)]
    assert not any("tsdf" in word or "meslam_1" in word for word in asked[0][1:])


class ScriptedCell(evaluation.Cell):
    """A cell whose work is a line of Python."""

    script = ""

    @property
    def command(self) -> list[str]:
        return [sys.executable, "-c", self.script.format(out=self.job.out, cell=CELL)]


def scripted(data: Path, out: Path, script: str) -> ScriptedCell:
    options = Namespace(
        seeds=1, other_seeds=1, methods=["tsdf"], frames=":", large_frames=":", cores=1
    )
    [cell] = evaluation.cells_of([Source(desk(data), "a desk")], options)
    job = evaluation.SlamRun(cell.job.sequence, "tsdf", 0, ":", 1, out)
    made = ScriptedCell(cell.source, job)
    object.__setattr__(made, "script", script)
    return made


FINISH = "import pathlib; p = pathlib.Path({out!r}); p.mkdir(); (p / {cell!r}).write_text('{{}}')"


def test_a_finished_cell_is_not_run_again(data, tmp_path):
    cell = scripted(data, tmp_path / "cell", FINISH.replace("{out!r}", "'{out}'"))
    console = Console(quiet=True)
    assert evaluation.run_all([cell], console) == {}
    assert cell.result == {"origin": "a desk"}
    # Its folder is there: another run would fail.
    assert evaluation.run_all([cell], console) == {}


def test_a_cell_that_fails_is_told_and_the_next_is_done(data, tmp_path):
    broken = scripted(data, tmp_path / "broken", "raise SystemExit('no memory is left')")
    fine = scripted(data, tmp_path / "fine", FINISH.replace("{out!r}", "'{out}'"))
    failures = evaluation.run_all([broken, fine], Console(quiet=True))
    assert list(failures.values()) == ["no memory is left"]
    assert fine.result is not None


def test_a_disagreement_stops_everything(data, tmp_path):
    script = f"import sys; print('evo says 3 mm', file=sys.stderr); sys.exit({DISAGREES})"
    cell = scripted(data, tmp_path / "cell", script)
    with pytest.raises(SystemExit, match="evo says 3 mm"):
        evaluation.run_all([cell], Console(quiet=True))


def fabricated(recording: str, method: str, ate_m: float, **others: object) -> dict[str, object]:
    return {
        "recording": recording,
        "origin": "made up",
        "method": method,
        "frames": ":",
        "seed": 0,
        "frames_offered": 100,
        "frames_tracked": 99,
        "ate_m": ate_m,
        "ate_online_m": 2 * ate_m,
        "rpe_m": None,
        "rpe_deg": 0.25,
        "evo": {"ate_m": ate_m, "ate_online_m": None},
        "fps": 20.0,
        "peak_rss_mb": 500.0,
        "map_bytes": 27_000,
        "load_average": 0.2,
        "others_cores": 0.01,
        "cores": 2,
        "version": "0.1.0 (abc)",
        "date": "2022-10-09",
        **others,
    }


def document(folder: Path, stem: str, cells: list[dict[str, object]]) -> str:
    abacus = {"cpu": "abacus", "cores": 2, "instruction_sets": [], "versions": {}}
    result = {"command": "make benchmark", "machine": abacus, "note": ""}
    result |= {"cells": cells, "failures": {"room, tsdf, seed 1": "no memory is left"}}
    (folder / "benchmarks").mkdir(exist_ok=True)
    (folder / "benchmarks" / f"{stem}.json").write_text(json.dumps(result))
    write_document(folder / "benchmarks", folder / "evaluation.md")
    return (folder / "evaluation.md").read_text()


def test_the_document_tells_seeds_range_noise_and_failures(tmp_path):
    cells = [fabricated("room", "meslam", ate_m, seed=n) for n, ate_m in enumerate((0.01, 0.03))]
    cells.append(fabricated("room", "tsdf", 0.05, others_cores=1.5, frames=":300"))
    text = document(tmp_path, "evaluation", cells)
    assert "| MeSLAM, 2 seeds | 99 of 100 | 2.00 (1.00-3.00) |" in text
    assert "20.0 !" in text
    assert "MeSLAM: all frames; TSDF SLAM (Open3D): the frames `:300` alone." in text
    assert "others computed during 1 of 3 cells" in text
    assert "**room, tsdf, seed 1** failed: no memory is left" in text
    assert "gives no answer to 3 trajectories" in text
    assert (tmp_path / "benchmarks" / "evaluation.png").stat().st_size > 1000
    assert "](benchmarks/evaluation.png)" in text


def test_ours_stands_beside_the_paper_where_the_sequence_is_the_same(tmp_path):
    text = document(tmp_path, "evaluation", [fabricated("freiburg1_desk", "meslam", 0.02)])
    assert "| MeSLAM, published | 6.0 | 6.54 | 7.5 |" in text
    assert "| MeSLAM, here | 2.00 | - | - |" in text
    assert "not at hand here: fr2/xyz, fr3/office." in text


def test_what_is_not_the_papers_is_said_not_to_be(tmp_path):
    text = document(tmp_path, "evaluation_quick", [fabricated("tum_fr1_xyz", "meslam", 0.02)])
    assert "here |" not in text.split("Table I\n")[1].split("Table II")[0]
    assert "no figures of the TUM sequences that were at hand: tum_fr1_xyz (TUM's fr1/xyz)" in text
