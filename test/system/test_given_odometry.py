"""A run on odometry that drifts: the map takes the drift out of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from data.drifting_odometry import drifting

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.pipeline import RunOptions, run
from meslam_core.simulation.simulator import Simulation, simulate
from meslam_core.trajectory import write_tum

CAMERA = PinholeCamera(320, 240, 307.5, 307.5, 159.5, 119.5)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate("room", 12.0, seed=0, fps=10.0, camera=CAMERA)


def test_the_trajectory_is_three_times_better_than_the_odometry_given(
    simulation: Simulation, tmp_path: Path
) -> None:
    odometry = drifting(simulation.truth, share=0.02, deg_m=1.0)
    write_tum(tmp_path / "truth.txt", simulation.truth)
    write_tum(tmp_path / "odometry.txt", odometry)
    config = MeslamConfig.from_overrides(["mapping.final_iterations=1000"])
    options = RunOptions(truth=tmp_path / "truth.txt", odometry=tmp_path / "odometry.txt")
    report = run(simulation, config, tmp_path / "out", options).report
    assert report["frames_tracked"] == len(simulation)
    given = absolute_error(odometry, simulation.truth).rmse_m
    assert given > 0.01
    assert report["ate_rmse_m"] < given / 3
    assert report["ate_online_rmse_m"] < given
