"""Surfaces compared: known distances between simple bodies."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.reconstruction import (
    depth_error,
    distances,
    observed_surface,
    sample,
    surface_error,
)
from meslam_core.evaluation.report import surface_entries
from meslam_core.trajectory import Trajectory

CAMERA = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)


def plane(depth: float, width: float = 4.0, left: float = -2.0) -> o3d.geometry.TriangleMesh:
    """A rectangle across the optical axis of a camera at the origin."""
    corners = np.array([[left, -1.5], [left + width, -1.5], [left + width, 1.5], [left, 1.5]])
    vertices = np.column_stack([corners, np.full(4, depth)])
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]])
    )


def standing_still(count: int = 3) -> Trajectory:
    return Trajectory(10**9 * np.arange(count), np.tile(np.eye(4), (count, 1, 1)))


def seen(surface: o3d.geometry.TriangleMesh) -> np.ndarray:
    return observed_surface(surface, CAMERA, standing_still(), every=1, pixel_step=1)


def test_observed_surface_is_what_the_image_covers():
    points = seen(plane(2.0))
    np.testing.assert_allclose(points[:, 2], 2.0, atol=1e-6)
    half = np.array([80, 60]) * 2.0 / 150
    np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=0), half, atol=0.02)
    # One point for each square of 2 cm, and no two closer than what one square allows.
    assert len(points) == pytest.approx((2 * half / 0.02).prod(), rel=0.1)


def test_observed_surface_ends_at_the_range():
    with pytest.raises(EvaluationError, match="same frame"):
        seen(plane(5.0))


def test_hidden_surface_is_not_observed():
    both = plane(2.0) + plane(3.0)
    np.testing.assert_allclose(seen(both)[:, 2], 2.0, atol=1e-6)


def test_perfect_reconstruction_has_no_error():
    surface = plane(2.0)
    error = surface_error(surface, surface, seen(surface), samples=1000)
    assert error.accuracy_mean_m < 1e-6
    assert error.completion_mean_m < 1e-6
    assert error.completion_ratio == 1.0


def test_shifted_reconstruction_is_off_by_the_shift():
    surface = plane(2.0)
    error = surface_error(plane(2.03), surface, seen(surface), samples=1000)
    for value in error.to_dict().values():
        assert value in (pytest.approx(0.03, abs=1e-4), 1.0)
    assert surface_error(plane(2.06), surface, seen(surface), samples=100).completion_ratio == 0.0


def test_half_a_reconstruction_is_accurate_but_half_complete():
    surface = plane(2.0)
    error = surface_error(plane(2.0, width=2.0), surface, seen(surface), samples=1000)
    assert error.accuracy_median_m < 1e-6
    # The margin of 5 cm beside the half that is there counts as complete.
    assert error.completion_ratio == pytest.approx(0.5 + 0.05 / 2.13, abs=0.02)


def test_reconstruction_is_moved_into_the_frame_of_the_truth():
    T_truth_map = se3.exp(np.array([0.5, -0.3, 1.0, 0.2, 0.5, -0.7]))
    surface, moved = plane(2.0), plane(2.0)
    moved.transform(se3.inverse(T_truth_map))
    before = np.asarray(moved.vertices).copy()
    error = surface_error(moved, surface, seen(surface), T_truth_map=T_truth_map, samples=1000)
    assert error.accuracy_mean_m < 1e-5
    depth = depth_error(moved, surface, CAMERA, standing_still(), T_truth_map=T_truth_map)
    assert depth.median_m < 1e-5
    np.testing.assert_array_equal(np.asarray(moved.vertices), before)


def test_depth_error_counts_holes_as_the_clip():
    depth = depth_error(plane(2.02, width=2.0), plane(2.0), CAMERA, standing_still())
    assert depth.median_m == pytest.approx(0.02, abs=1e-4)
    assert depth.coverage == pytest.approx(0.5, abs=0.01)
    assert depth.clipped_mean_m == pytest.approx(0.06, abs=0.001)


def test_report_of_a_mesh_names_every_error():
    truth, half_left = standing_still(), plane(2.02, width=2.0)
    entries = surface_entries(half_left, plane(2.0), CAMERA, truth, np.eye(4))
    assert entries["accuracy_median_m"] == pytest.approx(0.02, abs=1e-4)
    assert entries["depth_median_m"] == pytest.approx(0.02, abs=1e-4)
    assert entries["depth_coverage"] == pytest.approx(0.5, abs=0.02)
    assert entries["completion_ratio"] < 0.6


def test_samples_follow_the_area_and_repeat():
    mesh = plane(1.0, width=3.0, left=0.0) + plane(2.0, width=1.0, left=0.0)
    points = sample(mesh, 4000)
    assert (points[:, 2] == 1.0).mean() == pytest.approx(0.75, abs=0.03)
    np.testing.assert_array_equal(points, sample(mesh, 4000))


def test_distance_to_a_sphere_is_known():
    ball = o3d.geometry.TriangleMesh.create_sphere(0.5, resolution=60)
    points = np.array([[1.0, 0, 0], [0, 0.2, 0], [0, 0, -2.0]])
    np.testing.assert_allclose(distances(points, ball), [0.5, 0.3, 1.5], atol=2e-3)


def test_empty_reconstruction_is_refused():
    surface = plane(2.0)
    with pytest.raises(EvaluationError, match="no triangles"):
        surface_error(o3d.geometry.TriangleMesh(), surface, seen(surface))
