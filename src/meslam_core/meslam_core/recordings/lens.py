"""Lens distortion of a camera, and images freed of it."""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError

_NEGLIGIBLE = 1e-8
_PERSPECTIVE = ("plumb_bob", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye")
# Numbers of coefficients that OpenCV's models have.
_COUNTS = {**dict.fromkeys(_PERSPECTIVE, (4, 5, 8, 12, 14)), **dict.fromkeys(_FISHEYE, (4,))}

Maps = tuple[NDArray[Any], NDArray[Any]]

logger = logging.getLogger(__name__)


class Lens:
    """The distortion that a sensor_msgs CameraInfo describes; none by default."""

    def __init__(
        self, camera: PinholeCamera, model: str = "plumb_bob", coefficients: Any = ()
    ) -> None:
        """Check the coefficients; memory is taken when the first image is there.

        Args:
            camera: intrinsics, kept for the undistorted image.
            model: plumb_bob, rational_polynomial or equidistant; another one is ignored with a
                warning unless all its coefficients are zero.
            coefficients: in the order of OpenCV.

        Raises:
            FrameError: when coefficients are not finite, or the model has another number of them.
        """
        self._camera = camera
        self._model = model
        self._maps: Maps | None = None
        self._coefficients = np.asarray(coefficients, np.float64)
        count = self._coefficients.size
        if not np.isfinite(self._coefficients).all():
            raise FrameError(f"lens distortion coefficients {list(coefficients)} are not finite")
        self._bends = count > 0 and float(np.abs(self._coefficients).max()) >= _NEGLIGIBLE
        if not self._bends:
            return
        if model not in _COUNTS:
            logger.warning("lens distortion model %r is unknown and ignored", model)
            self._bends = False
        elif count not in _COUNTS[model]:
            expected = ", ".join(map(str, _COUNTS[model]))
            raise FrameError(f"{model} has {count} coefficients, expected {expected}")

    def undistort_color(self, color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The colour image (H, W, 3) as a pinhole camera would have seen it."""
        if not self._bends:
            return color
        return cv2.remap(color, *self._mapping(), cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def undistort_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """The depth image (H, W) [m] as a pinhole camera would have seen it; never interpolated."""
        if not self._bends:
            return depth_m
        remapped = cv2.remap(depth_m, *self._mapping(), cv2.INTER_NEAREST)
        return remapped.astype(np.float32, copy=False)

    def _mapping(self) -> Maps:
        """Where in the recorded image each pixel of the undistorted one is; made once."""
        if self._maps is None:
            matrix, size = self._camera.matrix, (self._camera.width, self._camera.height)
            fisheye = self._model in _FISHEYE
            make = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
            self._maps = make(matrix, self._coefficients, np.eye(3), matrix, size, cv2.CV_32FC1)
        return self._maps
