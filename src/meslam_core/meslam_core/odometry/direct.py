"""Direct RGB-D alignment in compiled code: the default registration.

Photometric and point-to-plane residuals on an image pyramid, weighted by t-distributions whose
scales are estimated (Kerl et al. 2013), with gain and offset of the light. Pyramids, gradients and
normals are made once a frame, not once a pair.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry.features import Features, find_features, propose_motion
from meslam_core.odometry.registration import WIDE_DISTANCE_FACTOR, Registration
from meslam_core.se3 import Pose, exp

_import_error = ""
try:
    from meslam_core.field import _kernel
except ImportError as error:
    _import_error = str(error)

LEVELS = 4
ITERATIONS = 10
# From a bad guess the search runs on images of 20x15 and 40x30 pixels.
SEARCH_LEVELS = 5
SEARCH_FINEST = 3
SEARCHED_TURNS = [
    exp(np.array([0.0, 0.0, 0.0, np.deg2rad(pitch), np.deg2rad(yaw), 0.0]))
    for yaw in (0.0, -8.0, 8.0, -16.0, 16.0)
    for pitch in (0.0, -8.0, 8.0)
]
CONVERGENCE = 1e-3
# Neighbouring residuals err together: so many tell as much as one.
CORRELATED = 50.0
MIN_VISIBLE = 300


def unavailable_reason() -> str:
    """Why direct alignment cannot be used, for people; empty where it can."""
    return f"the compiled kernel is not installed ({_import_error})" if _import_error else ""


class DirectFrame:
    """A frame ready for alignment; its features are found when they are first asked for.

    Attributes:
        pyramid: of the compiled kernel.
        gray: (H, W) uint8, at the image's own resolution.
        camera: intrinsics of that resolution.
    """

    def __init__(self, pyramid: Any, gray: NDArray[np.uint8], frame: RgbdFrame) -> None:
        self.pyramid = pyramid
        self.gray = gray
        self.camera = frame.camera
        self._depth_m = frame.depth_m

    @cached_property
    def features(self) -> Features:
        """Sparse features of the image at its full resolution."""
        return find_features(self.gray, self._depth_m, self.camera)


class DirectRegistrar:
    """Registration by the compiled kernel."""

    def __init__(self, odometry: OdometryConfig, sensor: SensorConfig) -> None:
        self._config = odometry
        self._sensor = sensor

    def prepare(self, frame: RgbdFrame) -> DirectFrame:
        camera = frame.camera
        halvings = 0
        while camera.width >> halvings > self._config.image_width:
            halvings += 1
        gray = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)
        pyramid = _kernel.RgbdPyramid(
            gray,
            np.ascontiguousarray(frame.depth_m, np.float32),
            min_depth=self._sensor.min_depth_m,
            max_depth=self._sensor.max_depth_m,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            halvings=halvings,
            levels=SEARCH_LEVELS,
        )
        return DirectFrame(pyramid, gray, frame)

    def register(
        self, source: DirectFrame, target: DirectFrame, T_target_source: Pose
    ) -> Registration:
        return _registration(self._align(source, target, T_target_source))

    def propose(self, source: DirectFrame, target: DirectFrame) -> Iterator[Pose]:
        motion = propose_motion(source.features, target.features)
        if motion is not None:
            yield motion

    def search(self, source: DirectFrame, target: DirectFrame, T_target_source: Pose) -> Pose:
        """The pose on coarse levels that agrees best, of turns to all sides of a guess.

        Fast motion of a camera is mostly turning.
        """
        limit = self._config.max_distance_m * WIDE_DISTANCE_FACTOR
        best, most = T_target_source, -1.0
        for turn in SEARCHED_TURNS:
            found = self._align(
                source,
                target,
                T_target_source @ turn,
                finest=SEARCH_FINEST,
                levels=SEARCH_LEVELS,
                max_distance_m=limit,
            )
            agreement = _agreement(found)
            if agreement > most:
                best, most = found["T_target_source"], agreement
        return best

    def _align(
        self,
        source: DirectFrame,
        target: DirectFrame,
        T_target_source: Pose,
        *,
        finest: int = 0,
        levels: int = LEVELS,
        max_distance_m: float | None = None,
    ) -> dict[str, Any]:
        found: dict[str, Any] = _kernel.align_rgbd(
            source.pyramid,
            target.pyramid,
            T_target_source,
            finest=finest,
            levels=levels,
            iterations=ITERATIONS,
            max_distance=max_distance_m or self._config.max_distance_m,
            convergence=CONVERGENCE,
            correlated=CORRELATED,
            luma_bias_m=self._config.luma_bias_m,
            luma_bias_rad=np.deg2rad(self._config.luma_bias_deg),
        )
        return found


def _registration(found: dict[str, Any]) -> Registration:
    visible, inliers = found["visible"], found["inliers"]
    fitness = agreement = 0.0
    if visible >= MIN_VISIBLE:
        # A D435 measures half of the pixels: holes say nothing about a pose.
        fitness = inliers / visible * found["in_view"] / found["points"]
        agreement = _agreement(found)
    residual_m = np.sqrt(found["squared_distance"] / inliers) if inliers else float("inf")
    return Registration(
        T_target_source=found["T_target_source"],
        information=found["information"],
        fitness=fitness,
        residual_m=residual_m,
        agreement=agreement,
    )


def _agreement(found: dict[str, Any]) -> float:
    """Share of points whose depth agrees, times the share that shows the same colour."""
    if not found["visible"]:
        return 0.0
    return float(found["inliers"] / found["visible"] * found["same_light"] / found["points"])
