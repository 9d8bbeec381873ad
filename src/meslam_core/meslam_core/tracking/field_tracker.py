"""Pose of a frame by Gauss-Newton on the field itself.

One sample a pixel, at its measured depth: on the surface f equals `surface_level`, so
(tr f - b) / |tr grad f| is the distance to the mapped surface [m] and its derivative by the
pose is exact, without rendering. Colour adds the difference of luma, as in coloured
registration (Park et al. 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meslam_core.config import TrackingConfig
from meslam_core.field.model import LUMA
from meslam_core.field.rendering import surface_level
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, exp, inverse, orthonormalized

SATURATION = 0.95
# Limits of the believed noise of a point's distance to the surface [m].
MIN_SPREAD_M = 0.003
MAX_SPREAD_M = 0.05
MIN_POINTS = 30


@dataclass(frozen=True)
class Alignment:
    """Result of aligning a frame with the field.

    Attributes:
        T_map_camera: (4, 4) pose.
        information: (6, 6) of (translation [m], rotation [rad]) about the camera centre, map axes.
        residual_m: median absolute distance to the surface [m].
        inlier_ratio: share within the inlier distance, of the points in observed space.
        observed_ratio: share of the points that lie in observed space.
        iterations: Gauss-Newton steps taken.
        converged: the last step was below the threshold.
    """

    T_map_camera: Pose
    information: NDArray[np.float64]
    residual_m: float
    inlier_ratio: float
    observed_ratio: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class PosePrior:
    """What is believed of a pose before the field is asked: odometry from the last pose on.

    Attributes:
        T_map_camera: (4, 4) mean.
        information: (6, 6) of (translation [m], rotation [rad]) about the camera centre, map axes.
    """

    T_map_camera: Pose
    information: NDArray[np.float64]

    def deviation(self, T_map_camera: Pose) -> NDArray[np.float64]:
        """How a pose differs from the mean (6,): (translation [m], rotation [rad]), map axes."""
        turned = T_map_camera[:3, :3] @ self.T_map_camera[:3, :3].T
        rotation = Rotation.from_matrix(turned).as_rotvec()
        return np.concatenate([T_map_camera[:3, 3] - self.T_map_camera[:3, 3], rotation])


@dataclass(frozen=True)
class _Residuals:
    """Distances [m], their pose derivatives, and the same for colour; one row a point."""

    distance: NDArray[np.float64]
    distance_jacobian: NDArray[np.float64]
    luma: NDArray[np.float64]
    luma_jacobian: NDArray[np.float64]
    usable: NDArray[np.bool_]
    observed: NDArray[np.bool_]


class FieldTracker:
    """Aligns frames with the working region's field."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config

    def align(
        self, region: Region, rays: Rays, T_map_camera: Pose, prior: PosePrior | None = None
    ) -> Alignment:
        """Refine a pose until the frame's points lie on the mapped surface.

        Args:
            region: the working region.
            rays: of the frame, camera frame.
            T_map_camera: (4, 4) first guess.
            prior: keeps the pose where geometry leaves it free, and smooth.
        """
        pose = T_map_camera.copy()
        converged = False
        iteration = 0
        information = np.zeros((6, 6))
        for iteration in range(1, self.config.iterations + 1):
            residuals = self._residuals(region, rays, pose)
            if np.count_nonzero(residuals.usable) < MIN_POINTS:
                break
            information, step = self._solve(rays, residuals, self._huber(iteration), pose, prior)
            if not np.isfinite(step).all():
                break
            motion = exp(np.concatenate([np.zeros(3), step[3:]]))
            pose[:3, :3] = motion[:3, :3] @ pose[:3, :3]
            pose[:3, 3] += step[:3]
            if np.linalg.norm(step[:3]) + np.linalg.norm(step[3:]) < self.config.convergence:
                converged = True
                break
        pose = orthonormalized(pose)
        residuals = self._residuals(region, rays, pose)
        distance = np.abs(residuals.distance[residuals.usable])
        inliers = int(np.count_nonzero(distance < self.config.inlier_distance_m))
        observed = int(np.count_nonzero(residuals.observed))
        return Alignment(
            T_map_camera=pose,
            information=information,
            residual_m=float(np.median(distance)) if len(distance) else float("inf"),
            inlier_ratio=inliers / max(observed, 1),
            observed_ratio=observed / max(len(rays), 1),
            iterations=iteration,
            converged=converged,
        )

    def robust_cost(self, region: Region, rays: Rays, T_map_camera: Pose) -> float:
        """Mean Geman-McClure cost in [0, 1] of a pose; compares first guesses."""
        residuals = self._residuals(region, rays, T_map_camera)
        squared = (residuals.distance / self.config.huber_narrow_m) ** 2
        cost = np.where(residuals.usable, squared / (1.0 + squared), 1.0)
        return float(np.mean(cost))

    def _huber(self, iteration: int) -> float:
        """The robust threshold narrows geometrically over the first four steps."""
        progress = min(1.0, (iteration - 1) / 3.0)
        wide, narrow = self.config.huber_wide_m, self.config.huber_narrow_m
        return float(wide * (narrow / wide) ** progress)

    def _residuals(self, region: Region, rays: Rays, pose: Pose) -> _Residuals:
        arms = (rays.directions.numpy() * rays.distances_m.numpy()[:, None]) @ pose[:3, :3].T
        T_region_map = inverse(region.T_map_region)
        points = (arms + pose[:3, 3]) @ T_region_map[:3, :3].T + T_region_map[:3, 3]
        values, field_gradient, field_luma_gradient = region.field.probe(
            np.ascontiguousarray(points / region.half_side_m, dtype=np.float32)
        )
        to_map = T_region_map[:3, :3] / region.half_side_m
        gradient = field_gradient.astype(np.float64) @ to_map
        luma_gradient = field_luma_gradient.astype(np.float64) @ to_map
        slope = np.linalg.norm(gradient, axis=1)
        # What the network says of space that nobody saw means nothing, and neither does its
        # gradient where it is saturated, far from any surface.
        observed = region.mask.lookup(points) > 0
        usable = observed & (np.abs(values[:, 0]) < SATURATION) & (slope > 1.0)
        slope = np.maximum(slope, 1e-6)
        distance = (values[:, 0] - surface_level(region.field.config)) / slope
        normal = gradient / slope[:, None]
        luma = values[:, 1:] @ np.array(LUMA) - rays.colors.numpy() @ np.array(LUMA)
        return _Residuals(
            distance=distance,
            distance_jacobian=np.concatenate([normal, np.cross(arms, normal)], axis=1),
            luma=luma,
            luma_jacobian=np.concatenate([luma_gradient, np.cross(arms, luma_gradient)], axis=1),
            usable=usable,
            observed=observed,
        )

    def _solve(
        self,
        rays: Rays,
        residuals: _Residuals,
        huber_m: float,
        pose: Pose,
        prior: PosePrior | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Information (6, 6) and step (6,) of one iteratively reweighted step."""
        depth = rays.distances_m.numpy()
        confidence = np.minimum(1.5, 1.0 / (0.5 + 0.125 * depth**2)) * residuals.usable
        weight = confidence * _huber_weight(residuals.distance, huber_m)
        jacobian = residuals.distance_jacobian
        information = (jacobian * weight[:, None]).T @ jacobian
        gradient = jacobian.T @ (weight * residuals.distance)
        if self.config.color_weight > 0.0:
            scale = self.config.color_weight
            weight = confidence * _huber_weight(scale * residuals.luma, huber_m) * scale**2
            jacobian = residuals.luma_jacobian
            information = information + (jacobian * weight[:, None]).T @ jacobian
            gradient = gradient + jacobian.T @ (weight * residuals.luma)
        # Neighbouring points err alike, in the depth image as in the map.
        sigma = _spread(residuals.distance[residuals.usable])
        scale = 1.0 / (sigma**2 * self.config.points_per_observation)
        information, gradient = information * scale, gradient * scale
        if prior is not None:
            information = information + prior.information
            gradient = gradient + prior.information @ prior.deviation(pose)
        damping = 1e-6 * np.trace(information) / 6.0 + 1e-9
        step = -np.linalg.solve(information + damping * np.eye(6), gradient)
        return information, step


def _huber_weight(residual: NDArray[np.float64], threshold: float) -> NDArray[np.float64]:
    return np.minimum(1.0, threshold / np.maximum(np.abs(residual), 1e-12))


def _spread(distance: NDArray[np.float64]) -> float:
    """Standard deviation [m] of residuals, from their median so that outliers do not count."""
    return float(np.clip(1.4826 * np.median(np.abs(distance)), MIN_SPREAD_M, MAX_SPREAD_M))
