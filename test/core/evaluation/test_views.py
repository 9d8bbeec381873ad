"""Views of meshes."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.views import render_mesh

CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)


def colored_plane() -> o3d.geometry.TriangleMesh:
    """At z = 2, black at the left edge to red at the right one; x and y from -1 to 1."""
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]]),
        o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]]),
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    return mesh


def test_colors_are_interpolated_and_depth_is_exact():
    color, depth = render_mesh(colored_plane(), CAMERA, np.eye(4))
    x = (np.arange(80) - CAMERA.cx) / CAMERA.fx * 2.0
    inside = np.abs(x) < 0.99
    expected = 255 * (x[inside] + 1) / 2
    np.testing.assert_allclose(color[30, inside, 0], expected, atol=1.0)
    assert (color[30, inside, 1:] == 0).all()
    np.testing.assert_allclose(depth[30, inside], 2.0, atol=1e-5)


def test_nothing_is_white_without_depth():
    color, depth = render_mesh(colored_plane(), CAMERA, np.eye(4))
    assert (color[30, 0] == 255).all()
    assert depth[30, 0] == 0


def test_moving_camera_and_mesh_together_changes_nothing():
    pose = se3.exp(np.array([0.3, 0.2, -0.4, 0.5, -0.2, 0.9]))
    still = render_mesh(colored_plane(), CAMERA, np.eye(4))
    moved = colored_plane()
    moved.transform(pose)
    both = render_mesh(moved, CAMERA, pose)
    assert np.mean(still[0] != both[0]) < 0.02
    np.testing.assert_allclose(still[1], both[1], atol=1e-4)


def test_mesh_without_colors_is_shaded_by_its_slant():
    mesh = o3d.geometry.TriangleMesh.create_sphere(0.5, resolution=40)
    mesh.translate((0, 0, 2))
    color, depth = render_mesh(mesh, CAMERA, np.eye(4))
    assert depth[30, 40] == pytest.approx(1.5, abs=0.01)
    rim = np.flatnonzero(depth[30] > 0)[0]
    assert color[30, 40, 0] > color[30, rim, 0] + 50


def test_empty_mesh_is_refused():
    with pytest.raises(EvaluationError, match="no triangles"):
        render_mesh(o3d.geometry.TriangleMesh(), CAMERA, np.eye(4))
