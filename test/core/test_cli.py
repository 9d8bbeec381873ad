"""The `meslam` command: every subcommand once, every kind of bad input, exit statuses."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from data.textured_room import CAMERA
from typer.testing import CliRunner

from meslam_core import __version__, point_query
from meslam_core.cli import app
from meslam_core.map.store import MapStore
from meslam_core.recordings import open_recording
from meslam_core.se3 import exp
from meslam_core.trajectory import Trajectory, write_tum

COMMANDS = [
    *("run", "evaluate", "mesh", "query", "merge", "info", "convert", "simulate"),
    *("report", "view", "doctor"),
]
QUICK = [
    "--set", "mapping.first_iterations=40", "--set", "mapping.iterations=2",
    "--set", "mapping.final_iterations=5", "--set", "keyframes.rays=512",
]  # fmt: skip
MESLAM = [sys.executable, "-c", "from meslam_core.cli import main; main()"]


def meslam(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def assert_refused(result, *words: str, status: int = 2) -> None:
    """One clear line on standard error, no traceback, nothing on standard output."""
    assert result.exit_code == status, result.output
    assert result.stdout == ""
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stderr.strip().splitlines()[-1].startswith("meslam: ")


@pytest.fixture
def folder(tmp_path, room_frames) -> Path:
    """A recording of four frames as a folder of images."""
    recording = tmp_path / "walk"
    for part in ("color", "depth"):
        (recording / part).mkdir(parents=True)
    for number, frame in enumerate(room_frames[:4]):
        depth_mm = np.rint(frame.depth_m * 1000).astype(np.uint16)
        cv2.imwrite(str(recording / "depth" / f"{number}.png"), depth_mm)
        cv2.imwrite(str(recording / "color" / f"{number}.png"), frame.color[..., ::-1])
    camera = CAMERA.to_dict() | {"fps": 15.0}
    (recording / "camera.json").write_text(json.dumps(camera))
    return recording


@pytest.fixture
def stored_map(tmp_path, finished_run) -> Path:
    """A copy of a map that a test may damage."""
    return Path(shutil.copytree(finished_run.out / "map.meslam", tmp_path / "room.meslam"))


def test_alone_it_says_what_to_do_next():
    result = meslam()
    assert result.exit_code == 0
    suggested = re.findall(r"^  meslam (\S+)", result.stdout, re.MULTILINE)
    assert {"simulate", "run", "view", "report", "doctor"} <= set(suggested)
    for word in set(suggested):
        assert word in meslam("--help").stdout


def test_the_version_is_told():
    assert meslam("--version").stdout.strip() == f"meslam {__version__}"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command):
    assert command in meslam("--help").stdout
    result = meslam(command, "--help")
    assert result.exit_code == 0
    assert "Usage: " in result.stdout


def test_help_is_quick():
    def computed_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    # Its own work, whatever else the computer does; torch alone would take more.
    before_s = computed_s()
    subprocess.run([*MESLAM, "--help"], check=True, capture_output=True)
    assert computed_s() - before_s < 0.5


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("meslam sim", {"simulate"}),
        ("meslam run room.mcap --pre", {"--preset"}),
        ("meslam run room.mcap --preset ", {"default", "fine", "paper", "imap_star"}),
        ("meslam simulate ", {"building", "corridor", "library", "room"}),
    ],
)
def test_the_shell_completes(typed, offered):
    asked = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split(" ")) - 1)}
    ended = subprocess.run(
        [sys.executable, "-c", "from meslam_core.cli import app; app(prog_name='meslam')"],
        env={**os.environ, **asked, "_MESLAM_COMPLETE": "complete_bash"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert set(ended.stdout.split()) == offered


@pytest.mark.parametrize(
    "arguments", [["fly"], ["run"], ["run", "x"], ["mesh", "x"], ["run", "x", "--out"]]
)
def test_wrong_usage_is_status_2(arguments):
    result = meslam(*arguments)
    assert result.exit_code == 2
    assert "Error: " in result.stderr


def test_run_tracks_a_folder_of_images(folder, tmp_path):
    result = meslam("run", folder, "--out", tmp_path / "out", *QUICK, "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["frames_tracked"] == 4
    assert report == json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["config"]["mapping"]["first_iterations"] == 40


def test_run_takes_its_options(folder, tmp_path, finished_run):
    camera = tmp_path / "other.json"
    camera.write_text(json.dumps(CAMERA.to_dict() | {"fx": 131.5}))
    options = ["--frames", "0:4:2", "--seed", 7, "--camera", camera, "--realtime"]
    result = meslam(
        "run", folder, "--out", tmp_path / "out", *QUICK, *options, "--preset", "default",
        "--truth", finished_run.truth, "--json",
    )  # fmt: skip
    report = json.loads(result.stdout)
    assert report["seed"] == 7
    assert report["camera"]["fx"] == 131.5
    assert report["realtime"]
    assert report["frames"] + report["frames_skipped"] == 2


def test_run_summarises_for_people(folder, tmp_path, finished_run):
    truth = ["--truth", finished_run.truth]
    result = meslam("run", folder, "--out", tmp_path / "out", *QUICK, *truth)
    assert result.exit_code == 0
    assert "4 of 4 frames tracked" in result.stdout
    assert "ATE" in result.stdout
    assert str(tmp_path / "out") in result.stdout


def test_the_same_seed_gives_the_same_trajectory(folder, tmp_path):
    for name in ("first", "second"):
        subprocess.run(
            [*MESLAM, "run", str(folder), "--out", str(tmp_path / name), *QUICK, "--frames", "0:3"],
            check=True,
            capture_output=True,
        )
    first, second = tmp_path / "first" / "trajectory.txt", tmp_path / "second" / "trajectory.txt"
    assert first.read_text() == second.read_text()


def test_run_states_that_a_recording_breaks_off(folder, tmp_path):
    (folder / "color" / "3.png").write_bytes(b"not an image")
    result = meslam("run", folder, "--out", tmp_path / "out", *QUICK)
    assert result.exit_code == 2
    assert "3.png" in result.stderr
    assert "results of the 3 frames before" in result.stderr
    assert "3 of 3 frames tracked" in result.stdout
    assert (tmp_path / "out" / "trajectory.txt").exists()


def test_run_ends_with_status_3_when_tracking_is_lost_for_good(folder, tmp_path):
    for number in (1, 2, 3):
        empty = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), empty)
    lost = ["--set", "tracking.lost_after_frames=2"]
    result = meslam("run", folder, "--out", tmp_path / "out", *QUICK, *lost)
    assert result.exit_code == 3
    assert "tracking was lost" in result.stderr
    assert (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--frames", "3"], ["--frames", "A:B"]),
        (["--frames", "4:2"], ["chooses nothing"]),
        (["--frames", "0:4:0"], ["chooses nothing"]),
        (["--frames", "9:"], ["none of its 4 frames"]),
        (["--preset", "best"], ["no preset 'best'", "default, fine, paper"]),
        (["--set", "field.size=3"], ["no setting field.size", "width"]),
        (["--set", "field.width=3"], ["outside [16, 512]"]),
        (["--camera", "nowhere.json"], ["nowhere.json", "fx, fy, cx, cy"]),
        (["--truth", "nowhere.txt"], ["nowhere.txt"]),
    ],
)
def test_run_refuses_options_that_make_no_sense(folder, tmp_path, options, words):
    assert_refused(meslam("run", folder, "--out", tmp_path / "out", *options), *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("missing.mcap", None, "does not exist"),
        ("empty.mcap", b"", "is empty"),
        ("noise.mcap", b"\x00noise" * 100, "is not a recording"),
        ("notes.txt", b"hello", "is not a recording"),
        ("cut.mcap", b"\x89MCAP0\r\n\x01\x00\x00", "cut.mcap"),
    ],
)
def test_run_refuses_what_is_no_recording(tmp_path, name, content, word):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    result = meslam("run", tmp_path / name, "--out", tmp_path / "out")
    assert_refused(result, name, word)
    assert not (tmp_path / "out").exists()


def test_run_refuses_a_folder_without_frames(folder, tmp_path):
    for part in ("color", "depth"):
        shutil.rmtree(folder / part)
        (folder / part).mkdir()
    assert_refused(meslam("run", folder, "--out", tmp_path / "out"), "no images")
    assert not (tmp_path / "out").exists()


def test_run_refuses_a_depth_image_of_another_size(folder, tmp_path):
    for file in (folder / "depth").iterdir():
        cv2.imwrite(str(file), np.full((60, 80), 1500, np.uint16))
    result = meslam("run", folder, "--out", tmp_path / "out")
    assert_refused(result, "0.png", "(60, 80)", "(120, 160)")
    assert not (tmp_path / "out").exists()


def test_run_refuses_a_camera_without_intrinsics(folder, tmp_path):
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_dict() | {"fx": 0.0}))
    assert_refused(meslam("run", folder, "--out", tmp_path / "out"), "camera.json")
    assert not (tmp_path / "out").exists()


def test_run_refuses_an_output_that_cannot_be_written(folder, tmp_path):
    (tmp_path / "file").write_text("")
    result = meslam("run", folder, "--out", tmp_path / "file" / "out")
    assert_refused(result, "cannot be written", "file/out")


def test_evaluate_compares_two_trajectories(finished_run):
    result = meslam("evaluate", finished_run.out / "trajectory.txt", finished_run.truth, "--json")
    assert result.exit_code == 0
    entries = json.loads(result.stdout)
    report = finished_run.outcome.report
    assert entries["ate_rmse_m"] == pytest.approx(report["ate_rmse_m"], abs=1e-6)
    assert entries["poses_compared"] == report["frames"]


def test_evaluate_fits_the_lever_arm(tmp_path):
    stamps = np.arange(60) * 100_000_000
    turns = [np.sin(0.1 * n + np.array([0.0, 1, 2, 3, 4, 5])) for n in range(60)]
    camera = np.array([exp(0.5 * turn) for turn in turns])
    mounting = exp(np.array([0.05, -0.1, 0.02, 0.3, 0.1, -0.2]))
    write_tum(tmp_path / "camera.txt", Trajectory(stamps, camera))
    write_tum(tmp_path / "sensor.txt", Trajectory(stamps, exp(turns[7]) @ camera @ mounting))
    files = [tmp_path / "camera.txt", tmp_path / "sensor.txt"]
    entries = json.loads(meslam("evaluate", *files, "--lever-arm", "--json").stdout)
    assert entries["ate_rmse_m"] < 1e-4
    assert entries["lever_arm_m"] == pytest.approx(np.linalg.norm(mounting[:3, 3]), abs=1e-4)
    assert json.loads(meslam("evaluate", *files, "--json").stdout)["ate_rmse_m"] > 0.005


def test_evaluate_refuses_what_is_no_trajectory(finished_run, tmp_path):
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    result = meslam("evaluate", tmp_path / "bad.txt", finished_run.truth)
    assert_refused(result, "bad.txt, line 1")
    assert_refused(meslam("evaluate", tmp_path / "none.txt", finished_run.truth), "none.txt")


def test_mesh_writes_a_coloured_mesh(stored_map, tmp_path):
    result = meslam("mesh", stored_map, "--out", tmp_path / "room.ply", "--resolution", "0.05")
    assert result.exit_code == 0, result.stderr
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "room.ply"))
    assert len(mesh.triangles) > 500
    assert mesh.has_vertex_colors()
    assert np.ptp(np.asarray(mesh.vertex_colors), axis=0).min() > 0.3


def test_mesh_refuses_what_it_cannot_do(stored_map, tmp_path):
    mesh = tmp_path / "room.ply"
    assert_refused(meslam("mesh", tmp_path / "none", "--out", mesh), "none", "does not exist")
    assert_refused(meslam("mesh", tmp_path, "--out", mesh), "no manifest.json")
    assert_refused(meslam("mesh", stored_map, "--out", mesh, "--resolution", "9"), "resolution")
    assert_refused(meslam("mesh", stored_map, "--out", tmp_path / "room.doc"), "room.doc", ".ply")
    assert not mesh.exists()


def test_a_damaged_map_is_named_with_status_2(stored_map, tmp_path):
    region = next(stored_map.glob("region_*"))
    region.write_bytes(region.read_bytes()[:-100])
    for arguments in (
        ["mesh", stored_map, "--out", tmp_path / "room.ply"],
        ["info", stored_map],
    ):
        assert_refused(meslam(*arguments), region.name)
    assert not (tmp_path / "room.ply").exists()


def test_the_intact_part_of_a_damaged_map_is_used_and_the_damage_stated(stored_map, tmp_path):
    store = MapStore(stored_map)
    loaded = store.load()
    first = loaded.regions[0]
    store.save([first, replace(first, index=(1, 0, 0))], loaded.grid)
    (damaged,) = stored_map.glob("region_1_0_0*")
    damaged.write_bytes(b"gone")
    result = meslam("mesh", stored_map, "--out", tmp_path / "room.ply", "--resolution", "0.05")
    assert result.exit_code == 2
    assert damaged.name in result.stderr
    assert (tmp_path / "room.ply").exists()


def test_query_answers_about_points(stored_map, tmp_path):
    np.save(tmp_path / "points.npy", np.array([[0.4, 0.0, 0.0], [1.4, 0, -0.7], [-9.0, 0, 0]]))
    paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npy"]
    result = meslam("query", stored_map, *paths)
    assert result.exit_code == 0, result.stderr
    answers = np.load(tmp_path / "answers.npy", allow_pickle=False)
    assert answers.shape == (3,)
    assert answers.dtype.names == ("occupancy", "probability", "density", "distance", "color")
    assert answers["occupancy"][0] == 0
    assert answers["probability"][0] < 0.1
    assert answers["density"][0] == 0.0
    assert answers["distance"][0] < 0.0
    assert answers["occupancy"][2] == -1
    assert answers["probability"][2] == 0.5
    assert np.isnan(answers["density"][2])


def test_query_in_portions_answers_the_same(stored_map, tmp_path, monkeypatch):
    np.save(tmp_path / "points.npy", np.random.default_rng(0).uniform(-1.0, 2.0, (50, 3)))
    for name, portion in (("whole.npy", 100), ("parts.npy", 7)):
        monkeypatch.setattr(point_query, "PORTION", portion)
        paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / name]
        assert meslam("query", stored_map, *paths).exit_code == 0
    whole, parts = (np.load(tmp_path / name) for name in ("whole.npy", "parts.npy"))
    for name in whole.dtype.names:
        np.testing.assert_allclose(whole[name], parts[name], atol=1e-5)


def test_query_takes_no_points(stored_map, tmp_path):
    np.save(tmp_path / "points.npy", np.zeros((0, 3), np.float32))
    paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npy"]
    assert meslam("query", stored_map, *paths).exit_code == 0
    assert np.load(tmp_path / "answers.npy").shape == (0,)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros(3),
        np.zeros((4, 2)),
        np.full((2, 3), np.nan),
        np.array([["a", "b", "c"]]),
        np.zeros((2, 3), complex),
    ],
)
def test_query_refuses_what_are_no_points(stored_map, tmp_path, points):
    np.save(tmp_path / "points.npy", points)
    paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npy"]
    assert_refused(meslam("query", stored_map, *paths), "points.npy", "(N, 3)")
    assert not (tmp_path / "answers.npy").exists()


def test_query_never_unpickles(stored_map, tmp_path):
    np.save(tmp_path / "points.npy", np.array([{"a": 1}], object), allow_pickle=True)
    paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / "answers.npy"]
    assert_refused(meslam("query", stored_map, *paths), "points.npy")


def test_query_names_a_place_that_cannot_be_written(stored_map, tmp_path):
    np.save(tmp_path / "points.npy", np.zeros((1, 3)))
    paths = ["--points", tmp_path / "points.npy", "--out", tmp_path / "no" / "answers.npy"]
    assert_refused(meslam("query", stored_map, *paths), "answers.npy")


def test_info_describes_a_recording(folder):
    facts = json.loads(meslam("info", folder, "--json").stdout)
    assert facts["frames"] == 4
    assert facts["camera"]["fx"] == CAMERA.fx
    assert "frames" in meslam("info", folder).stdout


def test_a_full_disk_behind_standard_output_is_told(folder):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*MESLAM, "info", str(folder)], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 2
    assert done.stderr.startswith("meslam: ")
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_impatient_user_is_not_kept_waiting_by_threads():
    program = (
        "import sys, threading, time\n"
        "from meslam_core import cli\n"
        "@cli.app.command()\n"
        "def stuck() -> None:\n"
        "    threading.Thread(target=time.sleep, args=(250,)).start()\n"
        "    raise KeyboardInterrupt\n"
        "sys.argv[1:] = ['stuck']\n"
        "cli.main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 130
    assert done.stderr == "meslam: interrupted; what was not complete is not kept\n"


def test_names_do_not_rule_the_terminal(tmp_path):
    recording = tmp_path / "\x1b[2Jnight\nfall.mcap"
    assert_refused(meslam("info", recording), "\\x1b[2Jnight\\nfall.mcap", "does not exist")


def test_info_describes_a_map(stored_map):
    facts = json.loads(meslam("info", stored_map, "--json").stdout)
    assert facts["regions"] == 1
    assert facts["region_list"][0]["index"] == [0, 0, 0]
    assert facts["bytes"] > 1000
    assert "region_side_m" in meslam("info", stored_map).stdout


def test_info_refuses_what_is_neither(tmp_path):
    assert_refused(meslam("info", tmp_path), "is not a recording")
    assert_refused(meslam("info", tmp_path / "none"), "does not exist")


def test_convert_writes_an_mcap_with_the_same_frames(folder, tmp_path):
    target = tmp_path / "walk.mcap"
    result = meslam("convert", folder, target)
    assert result.exit_code == 0, result.stderr
    source, converted = open_recording(folder), open_recording(target)
    for expected, frame in zip(source.frames(), converted.frames(), strict=True):
        assert frame.stamp_ns == expected.stamp_ns
        np.testing.assert_array_equal(frame.color, expected.color)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1e-3)
    converted.close()


def test_convert_leaves_nothing_half_written(folder, tmp_path):
    (folder / "color" / "3.png").write_bytes(b"not an image")
    before = sorted(tmp_path.iterdir())
    assert_refused(meslam("convert", folder, tmp_path / "walk.mcap"), "3.png")
    assert_refused(meslam("convert", folder, tmp_path / "walk.avi"), "walk.avi", ".mcap")
    assert sorted(tmp_path.iterdir()) == before


def test_simulate_records_a_walk_with_its_truth(tmp_path):
    target = tmp_path / "room.mcap"
    options = ["--duration", "0.3", "--fps", "10", "--seed", "2", "--out", target]
    result = meslam("simulate", "room", *options)
    assert result.exit_code == 0, result.stderr
    facts = json.loads(meslam("info", target, "--json").stdout)
    assert facts["frames"] == 3
    assert (tmp_path / "room.truth.txt").exists()
    assert (tmp_path / "room.surface.ply").exists()


def test_simulate_refuses_what_it_does_not_know(tmp_path):
    target = tmp_path / "moon.mcap"
    options = ["--out", target, "--duration"]
    assert_refused(meslam("simulate", "moon", *options, "1"), "no scene 'moon'", "room")
    assert_refused(meslam("simulate", "room", *options, "-1"), "positive")
    assert list(tmp_path.iterdir()) == []
