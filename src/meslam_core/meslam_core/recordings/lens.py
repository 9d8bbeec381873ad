"""Lens distortion of a camera, and images freed of it."""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera

_NEGLIGIBLE = 1e-8

logger = logging.getLogger(__name__)


class Lens:
    """The distortion that a sensor_msgs CameraInfo describes; none by default."""

    def __init__(
        self, camera: PinholeCamera, model: str = "plumb_bob", coefficients: Any = ()
    ) -> None:
        """Prepare the mapping from the undistorted image to the recorded one.

        Args:
            camera: intrinsics, kept for the undistorted image.
            model: plumb_bob, rational_polynomial or equidistant; another one is ignored with a
                warning unless all its coefficients are zero.
            coefficients: in the order of OpenCV.
        """
        self._maps: tuple[NDArray[Any], NDArray[Any]] | None = None
        coefficients = np.asarray(coefficients, np.float64)
        if coefficients.size == 0 or np.abs(coefficients).max() < _NEGLIGIBLE:
            return
        size = (camera.width, camera.height)
        rotation = np.eye(3)
        if model in ("plumb_bob", "rational_polynomial"):
            self._maps = cv2.initUndistortRectifyMap(
                camera.matrix, coefficients, rotation, camera.matrix, size, cv2.CV_32FC1
            )
        elif model in ("equidistant", "fisheye"):
            self._maps = cv2.fisheye.initUndistortRectifyMap(
                camera.matrix, coefficients[:4], rotation, camera.matrix, size, cv2.CV_32FC1
            )
        else:
            logger.warning("lens distortion model %r is unknown and ignored", model)

    def undistort_color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The colour image (H, W, 3) as a pinhole camera would have seen it."""
        if self._maps is None:
            return color
        return cv2.remap(color, *self._maps, cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def undistort_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """The depth image (H, W) [m] as a pinhole camera would have seen it; never interpolated."""
        if self._maps is None:
            return depth_m
        return cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST).astype(np.float32, copy=False)
