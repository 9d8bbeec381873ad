"""The benchmark of covariances: what it runs, and what it draws."""

from __future__ import annotations

import json

import covariance
import numpy as np
import pytest

from meslam_core.pose_covariance import PoseCovariances, write_covariances
from meslam_core.results import COVARIANCES, ONLINE_TRAJECTORY, REPORT
from meslam_core.se3 import exp
from meslam_core.trajectory import Trajectory, write_tum


def test_the_reach_is_that_of_the_ellipsoid_in_the_errors_direction():
    covariances = np.tile(np.diag([4.0, 1.0, 1.0]) * 1e-4, (2, 1, 1))
    reach = covariance.radii(np.array([[0.3, 0.0, 0.0], [0.0, 0.001, 0.0]]), covariances)
    np.testing.assert_allclose(reach, [0.0559, 0.02795], rtol=1e-3)


def test_every_run_has_results_of_its_own_and_some_were_not_chosen_with():
    assert len({case.out for case in covariance.CASES}) == len(covariance.CASES)
    assert len({case.name for case in covariance.CASES}) == len(covariance.CASES)
    assert sum(not case.calibrated for case in covariance.CASES) >= 3


def test_figures_of_a_finished_run_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(covariance, "CACHE", tmp_path / "cache")
    case = covariance.Case("walk", "truth.txt")
    seconds = np.arange(60) * 0.1
    truth = np.array([exp(np.array([0.2 * s, 0, 0, 0, 0.3 * np.sin(s), 0])) for s in seconds])
    stamps_ns = np.round(seconds * 1e9).astype(np.int64)
    poses = truth.copy()
    poses[30:, 1, 3] += 0.05
    (tmp_path / "walk").mkdir()
    case.out.mkdir(parents=True)
    write_tum(tmp_path / "walk" / "truth.txt", Trajectory(stamps_ns, truth))
    write_tum(case.out / ONLINE_TRAJECTORY, Trajectory(stamps_ns, poses))
    matrices = np.tile(1e-4 * np.eye(6), (60, 1, 1))
    write_covariances(case.out / COVARIANCES, PoseCovariances(stamps_ns, matrices))
    (case.out / REPORT).write_text(json.dumps({"frames_degraded": 0}))

    found = covariance.evaluated(case, tmp_path)
    assert found[0]["frames"] == 50
    assert found[0]["position"]["held"] == pytest.approx(0.4)
    assert found[0]["rotation"]["held"] == 1.0
    options = covariance.argparse.Namespace(out=tmp_path / "out")
    covariance.write([found], options)
    names = {file.name for file in options.out.iterdir()}
    assert names == {"covariance.txt", "covariance.json", "covariance.png"}
    assert "smallest is 40%" in (options.out / "covariance.txt").read_text()
