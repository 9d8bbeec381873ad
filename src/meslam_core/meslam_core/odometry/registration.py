"""Open3D's registrations: coloured point clouds (the paper's) and hybrid RGB-D odometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose
from meslam_core.threads import open3d as o3d

# Coarse to fine; every level runs until it converges, because a few fixed steps from a bad
# guess leave degrees of error under fast rotation.
HYBRID_ITERATIONS = (20, 15, 10)
# From a bad guess two more levels, down to 20x15 pixels, and a wider outlier limit come first:
# of motions of 7 cm from no guess at all, 6 % instead of 33 % end more than 5 cm off.
WIDE_ITERATIONS = (20, 20, 10, 1, 0)
WIDE_DISTANCE_FACTOR = 3.0
COLORED_ITERATIONS = 50
NORMAL_NEIGHBORS = 20
DEPTH_HUBER_M = 0.05
RESIDUAL_STRIDE = 16
INDEPENDENT_CORRESPONDENCES = 10.0


# Of what matches in depth at least 0.97 had the same colour in right registrations, at most 0.93 in
# wrong ones.
MIN_LIKENESS = 0.95


@dataclass(frozen=True)
class Registration:
    """How the source frame lies in the target's.

    Attributes:
        T_target_source: (4, 4).
        information: (6, 6) of (translation [m], rotation [rad]) about the target's origin,
            target axes.
        fitness: share of points with a correspondence.
        residual_m: RMS distance of the correspondences [m].
        agreement: in [0, 1], of colour and depth together; ranks registrations of one pair.
    """

    T_target_source: Pose
    information: NDArray[np.float64]
    fitness: float
    residual_m: float
    agreement: float = 0.0

    @property
    def looks_alike(self) -> bool:
        """Whether nearly all points that match in depth have the same colour, as in right ones."""
        return self.agreement >= MIN_LIKENESS * self.fitness


class Registrar(Protocol):
    """Prepares frames once and registers prepared pairs."""

    def prepare(self, frame: RgbdFrame) -> Any:
        """What registration needs of a frame."""
        ...

    def register(self, source: Any, target: Any, T_target_source: Pose) -> Registration:
        """Register two prepared frames from a first guess.

        Args:
            source, target: what `prepare` returned.
            T_target_source: (4, 4) first guess.

        Raises:
            RuntimeError: when the frames cannot be registered (Open3D's).
        """
        ...

    def propose(self, source: Any, target: Any) -> Iterator[Pose]:
        """First guesses of T_target_source (4, 4) from the images alone, the best one first."""
        ...

    def search(self, source: Any, target: Any, T_target_source: Pose) -> Pose:
        """A better first guess (4, 4) where `T_target_source` may be far off.

        Args:
            source, target: what `prepare` returned.
            T_target_source: (4, 4) what to search around.

        Raises:
            RuntimeError: when the frames cannot be registered (Open3D's).
        """
        ...


def _reduced(
    frame: RgbdFrame, odometry: OdometryConfig, sensor: SensorConfig
) -> tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]:
    """Colour, depth and camera at the odometry's resolution, a power of two smaller."""
    color, depth, camera = frame.color, frame.depth_m, frame.camera
    while camera.width > odometry.image_width and min(camera.width, camera.height) % 2 == 0:
        half = (camera.width // 2, camera.height // 2)
        color = np.asarray(cv2.resize(color, half, interpolation=cv2.INTER_AREA), np.uint8)
        # Averaging depth would invent points between foreground and background.
        depth = depth[::2, ::2]
        camera = PinholeCamera(
            camera.width // 2,
            camera.height // 2,
            camera.fx / 2,
            camera.fy / 2,
            camera.cx / 2,
            camera.cy / 2,
        )
    usable = (depth >= sensor.min_depth_m) & (depth <= sensor.max_depth_m)
    return color, np.where(usable, depth, np.float32(0.0)), camera


@dataclass(frozen=True)
class PreparedImages:
    """A frame as the hybrid method wants it, and what its quality is judged by."""

    image: Any
    intrinsics: Any
    depth_m: NDArray[np.float32]
    camera: PinholeCamera

    @property
    def measured_share(self) -> float:
        """Share of pixels with depth."""
        return float(np.mean(self.depth_m > 0))


class HybridRegistrar:
    """Open3D's RGB-D odometry with photometric and geometric terms on an image pyramid."""

    def __init__(self, odometry: OdometryConfig, sensor: SensorConfig) -> None:
        self._odometry = odometry
        self._sensor = sensor

    def prepare(self, frame: RgbdFrame) -> PreparedImages:
        color, depth, camera = _reduced(frame, self._odometry, self._sensor)
        image = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(color))),
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth))),
        )
        return PreparedImages(image, o3d.core.Tensor(camera.matrix), depth, camera)

    def propose(self, source: Any, target: Any) -> Iterator[Pose]:
        return iter(())

    def search(self, source: PreparedImages, target: PreparedImages, T_target_source: Pose) -> Pose:
        limit = self._odometry.max_distance_m * WIDE_DISTANCE_FACTOR
        found = self._hybrid(source, target, T_target_source, limit, WIDE_ITERATIONS)
        return np.asarray(found.transformation.numpy())

    def register(
        self, source: PreparedImages, target: PreparedImages, T_target_source: Pose
    ) -> Registration:
        limit = self._odometry.max_distance_m
        result = self._hybrid(source, target, T_target_source, limit, HYBRID_ITERATIONS)
        odometry = o3d.t.pipelines.odometry
        information = odometry.compute_odometry_information_matrix(
            source.image.depth,
            target.image.depth,
            source.intrinsics,
            result.transformation,
            limit,
            1.0,
            self._sensor.max_depth_m,
        )
        # Open3D counts correspondences among all pixels; a D435 measures only half of them.
        fitness = min(1.0, result.fitness / max(source.measured_share, 1e-3))
        transformation = result.transformation.numpy()
        residual_m = depth_residual_m(source, target, transformation, limit)
        return Registration(
            transformation, _scaled(information.numpy(), residual_m), fitness, residual_m, fitness
        )

    def _hybrid(
        self,
        source: PreparedImages,
        target: PreparedImages,
        T_target_source: Pose,
        limit_m: float,
        iterations: tuple[int, ...],
    ) -> Any:
        odometry = o3d.t.pipelines.odometry
        return odometry.rgbd_odometry_multi_scale(
            source.image,
            target.image,
            source.intrinsics,
            o3d.core.Tensor(T_target_source),
            1.0,
            self._sensor.max_depth_m,
            [odometry.OdometryConvergenceCriteria(n, 1e-6, 1e-6) for n in iterations],
            odometry.Method.Hybrid,
            odometry.OdometryLossParams(limit_m, min(DEPTH_HUBER_M, limit_m)),
        )


def _scaled(information: NDArray[np.float64], residual_m: float) -> NDArray[np.float64]:
    """Open3D's information (6, 6), of rotation first and for residuals of 1 m, as a pose's.

    Correspondences err together (of texture, of occlusion, of the sensor), so that thousands of
    them tell hardly more than a few independent ones.
    """
    order = [3, 4, 5, 0, 1, 2]
    information = information[np.ix_(order, order)]
    correspondences = max(np.trace(information[:3, :3]) / 3.0, 1.0)
    variance = np.clip(residual_m, 1e-3, 1.0) ** 2
    scaled: NDArray[np.float64] = information * (
        INDEPENDENT_CORRESPONDENCES / (correspondences * variance)
    )
    return scaled


def depth_residual_m(
    source: PreparedImages, target: PreparedImages, T_target_source: Pose, limit_m: float
) -> float:
    """RMS difference [m] of the depths that correspond; Open3D's own is in no metric unit."""
    rows, columns = np.nonzero(source.depth_m)
    rows, columns = rows[::RESIDUAL_STRIDE], columns[::RESIDUAL_STRIDE]
    points = source.camera.ray_directions(columns, rows) * source.depth_m[rows, columns][:, None]
    u, v, z = target.camera.project(points @ T_target_source[:3, :3].T + T_target_source[:3, 3])
    seen = (z > 0) & (u > -0.5) & (u < target.camera.width - 0.5)
    seen &= (v > -0.5) & (v < target.camera.height - 0.5)
    measured = target.depth_m[np.rint(v[seen]).astype(int), np.rint(u[seen]).astype(int)]
    difference = (z[seen] - measured)[measured > 0]
    difference = difference[np.abs(difference) < limit_m]
    return float(np.sqrt(np.mean(difference**2))) if len(difference) else float("inf")


class ColoredIcpRegistrar:
    """Coloured point-cloud registration (Park et al. 2017), the paper's odometry."""

    def __init__(self, odometry: OdometryConfig, sensor: SensorConfig) -> None:
        self._odometry = odometry
        self._sensor = sensor

    def prepare(self, frame: RgbdFrame) -> Any:
        color, depth, camera = _reduced(frame, self._odometry, self._sensor)
        rows, columns = np.nonzero(depth)
        points = camera.ray_directions(columns, rows) * depth[rows, columns][:, None]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
        cloud.colors = o3d.utility.Vector3dVector(color[rows, columns] / 255.0)
        if not len(points):
            return cloud
        cloud = cloud.voxel_down_sample(self._odometry.voxel_size_m)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBORS))
        cloud.orient_normals_towards_camera_location()
        return cloud

    def propose(self, source: Any, target: Any) -> Iterator[Pose]:
        return iter(())

    def search(self, source: Any, target: Any, T_target_source: Pose) -> Pose:
        registration = o3d.pipelines.registration
        found = registration.registration_icp(
            source,
            target,
            2.0 * self._odometry.max_distance_m * WIDE_DISTANCE_FACTOR,
            T_target_source,
            registration.TransformationEstimationPointToPlane(),
        )
        return np.array(found.transformation)

    def register(self, source: Any, target: Any, T_target_source: Pose) -> Registration:
        registration = o3d.pipelines.registration
        limit = 2.0 * self._odometry.max_distance_m
        result = registration.registration_colored_icp(
            source,
            target,
            limit,
            T_target_source,
            registration.TransformationEstimationForColoredICP(),
            registration.ICPConvergenceCriteria(1e-6, 1e-6, COLORED_ITERATIONS),
        )
        information = registration.get_information_matrix_from_point_clouds(
            source, target, limit, result.transformation
        )
        return Registration(
            np.array(result.transformation),
            _scaled(np.array(information), result.inlier_rmse),
            result.fitness,
            result.inlier_rmse,
            result.fitness,
        )
