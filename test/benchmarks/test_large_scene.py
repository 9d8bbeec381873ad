"""The benchmark of a large scene: what it makes of the figures that the runs leave."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import large_scene
import large_scene_errors
import large_scene_figures
import numpy as np
import pytest
from large_scene_figures import tables, widest

from meslam_core.config import MeslamConfig
from meslam_core.regions.grid import RegionGrid
from meslam_core.trajectory import Trajectory


def test_every_methods_settings_are_known_to_the_configuration():
    for method in large_scene.METHODS.values():
        config = MeslamConfig.from_overrides(method.settings, method.preset)
        assert config.regions.single == (method.name in _one_network())


def _one_network() -> list[str]:
    return [large_scene.METHODS[key].name for key in ("no_regions", "imap_star")]


def test_frames_are_chosen_for_all_methods_and_for_single_ones():
    options = argparse.Namespace(frames=["0:900", "meslam=:"])
    assert large_scene.frames_of("imap_star", options) == "0:900"
    assert large_scene.frames_of("meslam", options) == ":"
    other = large_scene.Job("meslam", "0:900", 0, Path("building.mcap"))
    assert other.out != large_scene.Job("meslam", ":", 0, Path("building.mcap")).out


def test_the_command_beside_the_results_names_no_files_of_this_machine():
    options = large_scene.parsed_options(["--recording", "/somewhere/b.mcap", "--seed", "2"])
    assert options.told == ["--seed", "2"]


def test_the_path_is_as_long_as_its_steps():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, 0, 3] = 3.0
    poses[2, 1, 3] = 4.0
    along = large_scene_errors.path_m(Trajectory(np.arange(3), poses))
    assert along.tolist() == [0.0, 3.0, 7.0]


def test_memory_is_compared_at_a_third_of_the_path_not_of_the_frames():
    # The camera stands still for the first frames.
    along = np.array([0, 0, 0, 0, 1, 2, 3], float)
    peaks = np.array([100, 110, 120, 130, 400, 410, 440], float)
    found = large_scene_errors.memory_over_path(peaks, along)
    assert (found["third_mb"], found["end_mb"]) == (400, 440)
    assert found["growth"] == pytest.approx(0.1)


def test_errors_are_medians_of_the_boxes_that_hold_enough():
    grid = RegionGrid.around(np.zeros(3), MeslamConfig().regions)
    count = large_scene_errors.LEAST_POINTS
    surface = np.zeros((2 * count + 1, 3))
    surface[count:, 0] = 1.1 * grid.spacing_m
    surface[-1, 0] = -grid.spacing_m
    errors = np.repeat([0.01, 0.03, 0.5], [count, count, 1])
    assert large_scene_errors.by_box(errors, surface, grid) == {(0, 0, 0): 0.01, (1, 0, 0): 0.03}


def visit(region: int, others: int, back: float | None, left: float | None) -> dict[str, Any]:
    def error(median_m: float | None) -> dict[str, Any] | None:
        return None if median_m is None else {"points": 1, "median_m": median_m, "mean_m": 0.0}

    return {
        "region": [region, 0, 0],
        "others": others,
        "error_at_return": error(back),
        "error_when_left": error(left),
    }


def test_a_return_is_compared_with_the_error_when_the_region_was_left():
    visits = [
        visit(0, -1, None, 0.010),
        visit(1, -1, None, 0.020),
        visit(0, 1, 0.011, 0.012),
        visit(2, -1, None, 0.030),
        visit(0, 12, 0.013, 0.014),
        visit(1, 14, 0.021, None),
    ]
    assert large_scene_errors.revisits(visits, others=10) == [
        {
            "region": [0, 0, 0],
            "others": 12,
            "left_m": 0.012,
            "return_m": 0.013,
            "left_again_m": 0.014,
        },
        {
            "region": [1, 0, 0],
            "others": 14,
            "left_m": 0.020,
            "return_m": 0.021,
            "left_again_m": None,
        },
    ]


def test_the_picture_shows_the_two_widest_axes():
    assert widest(np.array([[0, 0, 0], [1, 9, 5]])) == (1, 2)
    assert widest(np.array([[0, 0, 0], [7, 0.1, 5]])) == (0, 2)


def test_one_network_has_no_seams_and_still_its_rows():
    spread = {"median": 1.0, "p95": 2.0}
    figures = {
        "path_m": 10.0,
        "frames_tracked": 3,
        "frames": 4,
        "regions": 1,
        "ate_m": 0.02,
        "ate_of_path": 0.002,
        "ate_online_m": 0.03,
        "ate_online_of_path": 0.003,
        "map_error_m": {"median": 0.01, "worst": 0.02, "known": 0.9},
        "seams": None,
        "fps": 5.0,
        "stage_ms": dict.fromkeys(("odometry", "tracking", "mapping"), spread),
        "online_s": 1.0,
        "wall_s": 2.0,
        "memory": {"third_mb": 100.0, "end_mb": 101.0, "growth": 0.01},
        "peak_mb": 120.0,
        "map_bytes": 1000,
        "revisits": [],
    }
    found = tables({"imap_star": figures}, {"imap_star": "iMAP*"})
    assert [table.row_count for table in found] == [1, 1, 0]


def test_what_became_of_an_error_is_told_as_a_share_too():
    assert large_scene_figures._changed(0.011, 0.010) == "1.10 (+10%)"
    assert large_scene_figures._changed(None, 0.010) == "-"


def test_a_quick_run_needs_no_more_of_the_building_than_it_shows(monkeypatch, tmp_path):
    made = []

    def simulated(scene, path, *options):
        made.append((scene, path.name, *options))
        return path

    monkeypatch.setattr(large_scene, "simulated", simulated)
    for arguments in (["--quick"], [], ["--quick", "--recording", str(tmp_path / "b.mcap")]):
        large_scene.chosen_recording(large_scene.parsed_options(arguments))
    assert made == [
        ("building", "building_quick.mcap", "--duration", "4.0"),
        ("building", "building.mcap"),
    ]
