from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from map_server import CELL_M, Agreement, TrueSurface, cell_centers

from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.trajectory import Trajectory, write_tum


def test_agreement_counts_observed_cells() -> None:
    states = np.array([-1, 0, 0, 100, 100, 100], np.int8)
    truth_m = np.array([0.5, 0.5, -0.06, -0.06, 0.01, -0.3])
    found = Agreement.of(states, truth_m)
    assert (found.cells, found.occupied) == (5, 3)
    assert found.agree == pytest.approx(3 / 5)
    assert found.near == pytest.approx(1 / 3)
    assert found.whole == pytest.approx(3 / 4)
    assert found.free_right == pytest.approx(1 / 2)
    assert found.occupied_right == pytest.approx(2 / 3)


def test_the_true_surface_lies_in_the_map_frame(tmp_path) -> None:
    """A wall a metre before the first camera, which looks along the scene's y axis."""
    wall = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector([[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1]]),
        o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]]),
    )
    recording = tmp_path / "wall.mcap"
    o3d.io.write_triangle_mesh(str(tmp_path / "wall.surface.ply"), wall)
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    poses = np.stack([turn @ T_BODY_OPTICAL])
    write_tum(tmp_path / "wall.truth.txt", Trajectory(np.array([0]), poses))
    distance = TrueSurface(recording).distance_m(np.array([[0.7, 0.0, 0.0], [1.2, 0.1, 0.0]]))
    np.testing.assert_allclose(distance, [0.3, -0.2], atol=1e-5)


def test_cells_lie_on_multiples_of_their_side() -> None:
    centers = cell_centers(np.array([-0.04, 0.0, 0.0]), np.array([0.05, 0.1, 0.05]))
    assert len(centers) == 2 * 2 * 1
    np.testing.assert_allclose(centers.min(axis=0), [-0.5 * CELL_M, 0.5 * CELL_M, 0.5 * CELL_M])
