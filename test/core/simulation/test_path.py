"""The hand-held path of each scene."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from meslam_core.simulation.path import HandheldPath
from meslam_core.simulation.renderer import scene_surface
from meslam_core.simulation.scenes import build_scene

FPS = 15


def poses(duration_s: float, seed: int = 0) -> np.ndarray:
    path = HandheldPath(build_scene("room").route, duration_s, seed)
    return np.stack([path.pose(i / FPS) for i in range(round(duration_s * FPS))])


@pytest.mark.parametrize("duration_s", [20.0, 45.0])
def test_path_comes_back_to_its_start(duration_s):
    path = poses(duration_s)
    assert np.linalg.norm(path[-1, :3, 3] - path[0, :3, 3]) < 0.05
    turned = Rotation.from_matrix(path[0, :3, :3].T @ path[-1, :3, :3]).magnitude()
    assert np.degrees(turned) < 5


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("duration_s", [4.0, 20.0])
def test_motion_is_that_of_a_hand(duration_s, seed):
    path = poses(duration_s, seed)
    speeds = FPS * np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    turns = Rotation.from_matrix(path[:-1, :3, :3].transpose(0, 2, 1) @ path[1:, :3, :3])
    rates = FPS * np.degrees(turns.magnitude())
    assert 0.2 < np.median(speeds) < 0.4
    assert speeds.max() < 0.6
    assert rates.max() < 50


def test_poses_are_rigid():
    rotations = poses(5.0)[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * 75, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_camera_keeps_off_surfaces_and_inside_the_first_region(seed):
    positions = poses(20.0, seed)[:, :3, 3]
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(
        o3d.t.geometry.TriangleMesh.from_legacy(scene_surface(build_scene("room")))
    )
    query = o3d.core.Tensor.from_numpy(positions.astype(np.float32))
    assert caster.compute_distance(query).numpy().min() > 0.4
    assert (np.abs(positions - positions[0]).max(axis=1) < 1.55).mean() > 0.95


def test_seeds_differ_and_repeat():
    np.testing.assert_array_equal(poses(3.0, 1), poses(3.0, 1))
    assert np.abs(poses(3.0, 1) - poses(3.0, 2)).max() > 0.005
