"""Pose of a frame by Gauss-Newton on the field itself.

One sample a pixel, at its measured depth: on the surface f equals `surface_level`, so
(tr f - b) / |tr grad f| is the distance to the mapped surface [m] and its derivative by the
pose is exact, without rendering. Colour adds the difference of luma, as in coloured
registration (Park et al. 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import TrackingConfig
from meslam_core.field.alignment import AlignmentSettings, NormalEquations
from meslam_core.field.model import LUMA
from meslam_core.field.rendering import surface_level
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import (
    Pose,
    exp,
    inverse,
    orthonormalized,
    rotation_angle,
    rotation_vector,
)
from meslam_core.tracking.field_equations import field_equations

Floats = NDArray[np.float32]

SATURATION = 0.95
# A flatter f [1/m] tells nothing of where the surface is.
MIN_SLOPE = 1.0
# Limits of the believed noise of a point's distance to the surface [m].
MIN_SPREAD_M = 0.003
MAX_SPREAD_M = 0.05
MIN_POINTS = 30
# The first steps bring a pose near, for which about so many points suffice.
COARSE_STEPS = 2
COARSE_POINTS = 500
# First guesses are told apart by about so many points, if they are farther apart than this.
RANKING_POINTS = 400
SAME_DISTANCE_M = 0.001
SAME_ANGLE_RAD = float(np.deg2rad(0.05))


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
        covariance: (6, 6) of (translation [m], rotation [rad]) about the camera centre, map axes.
    """

    T_map_camera: Pose
    covariance: NDArray[np.float64]

    @cached_property
    def information(self) -> NDArray[np.float64]:
        """Inverse of the covariance (6, 6)."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    def deviation(self, T_map_camera: Pose) -> NDArray[np.float64]:
        """How a pose differs from the mean (6,): (translation [m], rotation [rad]), map axes."""
        rotation = rotation_vector(T_map_camera[:3, :3] @ self.T_map_camera[:3, :3].T)
        return np.concatenate([T_map_camera[:3, 3] - self.T_map_camera[:3, 3], rotation])


@dataclass(frozen=True)
class _Measured:
    """What a frame measured, as every step needs it; one row a point.

    Attributes:
        ends: (N, 3) float32, camera frame [m].
        luma: (N,) float32.
        confidence: (N,) float32, from the depth camera's noise.
    """

    ends: Floats
    luma: Floats
    confidence: Floats

    def __len__(self) -> int:
        return len(self.luma)

    @classmethod
    def of(cls, rays: Rays) -> _Measured:
        depth = rays.distances_m.numpy()
        return cls(
            ends=rays.directions.numpy() * depth[:, None],
            luma=rays.colors.numpy() @ np.array(LUMA, np.float32),
            confidence=np.minimum(1.5, 1.0 / (0.5 + 0.125 * depth**2)).astype(np.float32),
        )

    def some(self, count: int) -> _Measured:
        """About `count` of the points, evenly chosen; all where there are fewer."""
        stride = max(1, len(self) // count)
        if stride == 1:
            return self
        parts = (self.ends, self.luma, self.confidence)
        return _Measured(*(np.ascontiguousarray(part[::stride]) for part in parts))


@dataclass(frozen=True)
class _Fit:
    """A frame's points against the field at one pose.

    Attributes:
        equations: weighted by confidence and robustly.
        observed: number of points in space that was observed.
        errors_m: absolute distances to the surface [m] of the points that can be used.
    """

    equations: NormalEquations
    observed: int
    errors_m: Floats


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
        measured = _Measured.of(rays)
        coarse = measured.some(COARSE_POINTS)
        pose = T_map_camera.copy()
        converged = False
        iteration = 0
        information = np.zeros((6, 6))
        for iteration in range(1, self.config.iterations + 1):
            points = coarse if iteration <= COARSE_STEPS else measured
            fit = self._fit(region, points, pose, self._huber(iteration))
            share = len(points) / max(len(measured), 1)
            if len(fit.errors_m) < MIN_POINTS * share:
                break
            information, step = self._solve(fit, pose, prior, share)
            if not np.isfinite(step).all():
                break
            motion = exp(np.concatenate([np.zeros(3), step[3:]]))
            pose[:3, :3] = motion[:3, :3] @ pose[:3, :3]
            pose[:3, 3] += step[:3]
            length = np.linalg.norm(step[:3]) + np.linalg.norm(step[3:])
            if points is measured and length < self.config.convergence:
                converged = True
                break
        pose = orthonormalized(pose)
        if not converged:
            fit = self._fit(region, measured, pose)
        inliers = int(np.count_nonzero(fit.errors_m < self.config.inlier_distance_m))
        return Alignment(
            T_map_camera=pose,
            information=information,
            residual_m=float(np.median(fit.errors_m)) if len(fit.errors_m) else float("inf"),
            inlier_ratio=inliers / max(fit.observed, 1),
            observed_ratio=fit.observed / max(len(rays), 1),
            iterations=iteration,
            converged=converged,
        )

    def ranked(self, region: Region, rays: Rays, guesses: Sequence[Pose]) -> list[Pose]:
        """First guesses of a frame's pose, the best first; of those that agree only the first.

        Args:
            region: the working region.
            rays: of the frame, camera frame.
            guesses: (4, 4) T_map_camera each.
        """
        distinct: list[Pose] = []
        for guess in guesses:
            if not any(_agree(guess, other) for other in distinct):
                distinct.append(guess)
        if len(distinct) < 2:
            return distinct
        points = _Measured.of(rays).some(RANKING_POINTS)
        return sorted(distinct, key=lambda guess: self._robust_cost(region, points, guess))

    def robust_cost(self, region: Region, rays: Rays, T_map_camera: Pose) -> float:
        """Mean Geman-McClure cost in [0, 1] of a pose, from some of the rays."""
        return self._robust_cost(region, _Measured.of(rays).some(RANKING_POINTS), T_map_camera)

    def _robust_cost(self, region: Region, measured: _Measured, pose: Pose) -> float:
        errors = self._fit(region, measured, pose).errors_m
        squared = (errors / self.config.huber_narrow_m) ** 2
        unusable = len(measured) - len(errors)
        return float((np.sum(squared / (1.0 + squared)) + unusable) / max(len(measured), 1))

    def _huber(self, iteration: int) -> float:
        """The robust threshold narrows geometrically until all points are used."""
        progress = min(1.0, (iteration - 1) / COARSE_STEPS)
        wide, narrow = self.config.huber_wide_m, self.config.huber_narrow_m
        return float(wide * (narrow / wide) ** progress)

    def _fit(
        self, region: Region, measured: _Measured, pose: Pose, huber_m: float | None = None
    ) -> _Fit:
        """Compare points with the field; without a robust threshold only their distances count."""
        T_region_map = inverse(region.T_map_region)
        # Composed before it meets the points: far from the map's origin single precision is coarse.
        T_region_camera = (T_region_map @ pose).astype(np.float32)
        points = measured.ends @ T_region_camera[:3, :3].T + T_region_camera[:3, 3]
        # What the network says of space that nobody saw means nothing, and neither does its
        # gradient where it is saturated, far from any surface.
        observed = region.mask.lookup(points) > 0
        equations = field_equations(
            region.field,
            points / np.float32(region.half_side_m),
            measured.ends @ pose[:3, :3].T.astype(np.float32),
            measured.luma,
            measured.confidence * observed,
            AlignmentSettings(
                to_map=T_region_map[:3, :3] / region.half_side_m,
                surface_level=surface_level(region.field.config),
                saturation=SATURATION,
                min_slope=MIN_SLOPE,
                huber_m=self.config.huber_narrow_m if huber_m is None else huber_m,
                color_weight=0.0 if huber_m is None else self.config.color_weight,
            ),
        )
        errors = np.abs(equations.distance_m[equations.usable])
        return _Fit(equations, int(np.count_nonzero(observed)), errors)

    def _solve(
        self, fit: _Fit, pose: Pose, prior: PosePrior | None, share: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Information (6, 6) and step (6,) of one iteratively reweighted step.

        A share of the points stands for all of them, or the prior would weigh more.
        """
        # Neighbouring points err alike, in the depth image as in the map.
        sigma = _spread(fit.errors_m)
        scale = 1.0 / (sigma**2 * self.config.points_per_observation * share)
        information = fit.equations.information * scale
        gradient = fit.equations.gradient * scale
        if prior is not None:
            information = information + prior.information
            gradient = gradient + prior.information @ prior.deviation(pose)
        damping = 1e-6 * np.trace(information) / 6.0 + 1e-9
        step = -np.linalg.solve(information + damping * np.eye(6), gradient)
        return information, step


def _spread(errors_m: Floats) -> float:
    """Standard deviation [m] of residuals, from their median so that outliers do not count."""
    return float(np.clip(1.4826 * np.median(errors_m), MIN_SPREAD_M, MAX_SPREAD_M))


def _agree(first: Pose, second: Pose) -> bool:
    """Whether two poses are so close that there is nothing to choose."""
    distance = np.linalg.norm(first[:3, 3] - second[:3, 3])
    return bool(
        distance < SAME_DISTANCE_M
        and rotation_angle(first[:3, :3].T @ second[:3, :3]) < SAME_ANGLE_RAD
    )
