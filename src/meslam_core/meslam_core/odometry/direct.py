"""Direct RGB-D alignment in compiled code: the default registration.

Photometric and point-to-plane residuals on an image pyramid, weighted by t-distributions whose
scales are estimated (Kerl et al. 2013), with gain and offset of the light. Five times faster than
Open3D's hybrid method at the same resolution, because pyramids, gradients and normals are made
once a frame and not once a pair.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry.registration import WIDE_DISTANCE_FACTOR, Registration
from meslam_core.se3 import Pose

_import_error = ""
try:
    from meslam_core.field import _kernel
except ImportError as error:
    _import_error = str(error)

LEVELS = 4
ITERATIONS = 10
# From a bad guess the search begins on images of 20x15 pixels.
WIDE_LEVELS = 5
WIDE_ITERATIONS = 20
CONVERGENCE = 5e-4
# Neighbouring residuals err together: so many tell as much as one.
CORRELATED = 50.0
MIN_VISIBLE = 300


def unavailable_reason() -> str:
    """Why direct alignment cannot be used, for people; empty where it can."""
    return f"the compiled kernel is not installed ({_import_error})" if _import_error else ""


class DirectRegistrar:
    """Registration by the compiled kernel."""

    def __init__(self, odometry: OdometryConfig, sensor: SensorConfig) -> None:
        self._config = odometry
        self._sensor = sensor

    def prepare(self, frame: RgbdFrame) -> Any:
        camera = frame.camera
        halvings = 0
        while camera.width >> halvings > self._config.image_width:
            halvings += 1
        return _kernel.RgbdPyramid(
            cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY),
            np.ascontiguousarray(frame.depth_m, np.float32),
            min_depth=self._sensor.min_depth_m,
            max_depth=self._sensor.max_depth_m,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            halvings=halvings,
            levels=WIDE_LEVELS,
        )

    def register(
        self, source: Any, target: Any, T_target_source: Pose, *, wide: bool = False
    ) -> Registration:
        limit = self._config.max_distance_m
        found = None
        if wide:
            found = self._align(
                source,
                target,
                T_target_source,
                WIDE_LEVELS,
                WIDE_ITERATIONS,
                limit * WIDE_DISTANCE_FACTOR,
            )
            T_target_source = found["T_target_source"]
        found = self._align(source, target, T_target_source, LEVELS, ITERATIONS, limit)
        visible, inliers = found["visible"], found["inliers"]
        fitness = 0.0
        if visible >= MIN_VISIBLE:
            # A D435 measures half of the pixels: holes say nothing about a pose.
            fitness = inliers / visible * found["in_view"] / found["points"]
        residual_m = np.sqrt(found["squared_distance"] / inliers) if inliers else float("inf")
        return Registration(
            T_target_source=found["T_target_source"],
            information=found["information"],
            fitness=fitness,
            residual_m=residual_m,
        )

    def _align(
        self,
        source: Any,
        target: Any,
        T_target_source: Pose,
        levels: int,
        iterations: int,
        max_distance_m: float,
    ) -> dict[str, Any]:
        found: dict[str, Any] = _kernel.align_rgbd(
            source,
            target,
            T_target_source,
            levels=levels,
            iterations=iterations,
            max_distance=max_distance_m,
            convergence=CONVERGENCE,
            correlated=CORRELATED,
            luma_bias_m=self._config.luma_bias_m,
            luma_bias_rad=np.deg2rad(self._config.luma_bias_deg),
        )
        return found
