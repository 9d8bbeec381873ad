"""How far a reconstructed mesh is from the true surface, as NICE-SLAM reports it.

Zhu et al., *NICE-SLAM: Neural Implicit Scalable Encoding for SLAM*, CVPR 2022, Sec. 4; distances
are to the other surface itself instead of to points sampled on it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.views import MeshRenderer
from meslam_core.se3 import Pose
from meslam_core.trajectory import Trajectory

COMPLETION_DISTANCE_M = 0.05
DEPTH_CLIP_M = 0.10


@dataclass(frozen=True)
class SurfaceError:
    """Errors of a reconstruction [m].

    Attributes:
        accuracy_median_m, accuracy_mean_m: from the reconstruction to the true surface.
        completion_median_m, completion_mean_m: from the observed true surface to the
            reconstruction.
        completion_ratio: share of the observed true surface within the completion distance.
    """

    accuracy_median_m: float
    accuracy_mean_m: float
    completion_median_m: float
    completion_mean_m: float
    completion_ratio: float

    def to_dict(self) -> dict[str, float]:
        """Plain numbers for a report."""
        return asdict(self)


@dataclass(frozen=True)
class DepthError:
    """Errors of depth rendered from a reconstruction at true poses.

    Attributes:
        median_m: over all pixels where both have depth [m].
        clipped_mean_m: mean of errors clipped at DEPTH_CLIP_M, pixels without rendered depth
            counting as that [m].
        coverage: share of the true pixels with rendered depth.
    """

    median_m: float
    clipped_mean_m: float
    coverage: float

    def to_dict(self) -> dict[str, float]:
        """Plain numbers for a report, named as depth errors."""
        return {f"depth_{name}": value for name, value in asdict(self).items()}


def observed_surface(
    surface: o3d.geometry.TriangleMesh,
    camera: PinholeCamera,
    truth: Trajectory,
    *,
    nearest_m: float = 0.28,
    farthest_m: float = 4.0,
    spacing_m: float = 0.02,
    every: int = 5,
    pixel_step: int = 4,
) -> NDArray[np.float32]:
    """Points of the true surface that the camera has seen within its range.

    Args:
        surface: the exact surface in the truth's frame [m].
        camera: intrinsics.
        truth: T_truth_camera of the recording.
        nearest_m, farthest_m: range of depth that counts [m].
        spacing_m: one point is kept in each cube of this side [m].
        every: use every so many poses.
        pixel_step: use every so many pixels along rows and columns.

    Returns:
        (N, 3) float32 in the truth's frame [m].

    Raises:
        EvaluationError: when the camera saw nothing of the surface.
    """
    renderer = MeshRenderer(surface)
    coarse = camera.scaled(1 / pixel_step)
    directions = coarse.pixel_directions()
    points = np.empty((0, 3), np.float32)
    for pose in truth.poses[::every]:
        _, depth = renderer.render(coarse, pose)
        seen = (depth >= nearest_m) & (depth <= farthest_m)
        local = directions[seen] * depth[seen][:, None]
        world = local @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)
        points = _one_a_cube(np.concatenate([points, world]), spacing_m)
    if not len(points):
        raise EvaluationError(
            f"no surface lies between {nearest_m} and {farthest_m} m of the camera's poses; "
            "are both in the same frame?"
        )
    return points


def surface_error(
    reconstruction: o3d.geometry.TriangleMesh,
    surface: o3d.geometry.TriangleMesh,
    observed: NDArray[np.floating],
    *,
    T_truth_map: Pose | None = None,
    completion_distance_m: float = COMPLETION_DISTANCE_M,
    samples: int = 100_000,
) -> SurfaceError:
    """Accuracy and completion of a reconstruction.

    Args:
        reconstruction: in the map's frame [m].
        surface: the exact surface in the truth's frame [m].
        observed: (N, 3) points of it that were seen (see `observed_surface`).
        T_truth_map: (4, 4) maps the map's frame into the truth's; None for the identity.
        completion_distance_m: what counts as reconstructed [m].
        samples: number of points on the reconstruction.

    Raises:
        EvaluationError: when a mesh has no triangles.
    """
    moved = _moved(reconstruction, T_truth_map)
    accuracy = distances(sample(moved, samples), surface)
    completion = distances(observed, moved)
    return SurfaceError(
        accuracy_median_m=float(np.median(accuracy)),
        accuracy_mean_m=float(accuracy.mean()),
        completion_median_m=float(np.median(completion)),
        completion_mean_m=float(completion.mean()),
        completion_ratio=float((completion < completion_distance_m).mean()),
    )


def depth_error(
    reconstruction: o3d.geometry.TriangleMesh,
    surface: o3d.geometry.TriangleMesh,
    camera: PinholeCamera,
    truth: Trajectory,
    *,
    T_truth_map: Pose | None = None,
    farthest_m: float = 4.0,
    views: int = 20,
    pixel_step: int = 2,
) -> DepthError:
    """Error of the reconstruction's depth seen from true poses, evenly chosen.

    Raises:
        EvaluationError: when a mesh has no triangles or no view shows the true surface.
    """
    coarse = camera.scaled(1 / pixel_step)
    renderer = MeshRenderer(_moved(reconstruction, T_truth_map))
    true_renderer = MeshRenderer(surface)
    errors, covered = [], []
    for index in np.linspace(0, len(truth) - 1, min(views, len(truth))).round().astype(int):
        _, depth = renderer.render(coarse, truth.poses[index])
        _, true_depth = true_renderer.render(coarse, truth.poses[index])
        inside = (true_depth > 0) & (true_depth <= farthest_m)
        covered.append(depth[inside] > 0)
        errors.append(np.abs(depth[inside] - true_depth[inside]))
    error, has_depth = np.concatenate(errors), np.concatenate(covered)
    if not len(error):
        raise EvaluationError("no view shows the true surface; are poses and surface in one frame?")
    clipped = np.where(has_depth, np.minimum(error, DEPTH_CLIP_M), DEPTH_CLIP_M)
    return DepthError(
        median_m=float(np.median(error[has_depth])) if has_depth.any() else float("inf"),
        clipped_mean_m=float(clipped.mean()),
        coverage=float(has_depth.mean()),
    )


def sample(mesh: o3d.geometry.TriangleMesh, count: int) -> NDArray[np.float32]:
    """Points (count, 3) spread evenly over a mesh's area, the same every time.

    Raises:
        EvaluationError: when the mesh has no triangles.
    """
    if not mesh.has_triangles():
        raise EvaluationError("the reconstruction has no triangles; was anything mapped?")
    rng = np.random.default_rng(0)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    edges = corners[:, 1:] - corners[:, :1]
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    chosen = np.searchsorted(np.cumsum(areas), rng.random(count) * areas.sum())
    chosen = np.minimum(chosen, len(areas) - 1)
    shares = rng.random((count, 2))
    outside = shares.sum(axis=1) > 1
    shares[outside] = 1 - shares[outside]
    points = corners[chosen, 0] + np.einsum("nk,nkj->nj", shares, edges[chosen])
    return np.asarray(points, np.float32)


def distances(points: NDArray[np.floating], mesh: o3d.geometry.TriangleMesh) -> NDArray[np.float32]:
    """Distance of each point (N, 3) to a mesh [m].

    Raises:
        EvaluationError: when the mesh has no triangles.
    """
    if not mesh.has_triangles():
        raise EvaluationError("a distance to a mesh without triangles does not exist")
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32))
    found: NDArray[np.float32] = caster.compute_distance(query).numpy()
    return found


def _moved(mesh: o3d.geometry.TriangleMesh, transform: Pose | None) -> o3d.geometry.TriangleMesh:
    """A copy of a mesh in another frame."""
    moved = o3d.geometry.TriangleMesh(mesh)
    if transform is not None:
        moved.transform(transform)
    return moved


def _one_a_cube(points: NDArray[np.float32], side_m: float) -> NDArray[np.float32]:
    """The first point in each cube of a lattice."""
    cells = np.floor(points / side_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    extent = cells.max(axis=0, initial=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, first = np.unique(keys, return_index=True)
    return np.asarray(points[np.sort(first)])
