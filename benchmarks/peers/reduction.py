"""Frames at a smaller resolution."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame


def reduced(frame: RgbdFrame, width: int) -> RgbdFrame:
    """The frame, halved until it is not wider than `width` [px] or has odd sides.

    Depth is the lower median of what was measured in each 2x2 pixels, as in librealsense's
    decimation filter: averages would invent points between foreground and background, and single
    pixels would double the holes of a D435.
    """
    while frame.camera.width > width and frame.camera.width % 2 == frame.camera.height % 2 == 0:
        camera = frame.camera.scaled(0.5)
        size = (camera.width, camera.height)
        color = np.asarray(cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA), np.uint8)
        frame = RgbdFrame(frame.stamp_ns, color, _halved(frame.depth_m), camera)
    return frame


def _halved(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Lower median of the measured pixels of each 2x2; 0 where there is none."""
    height, width = depth_m.shape
    blocks = depth_m.reshape(height // 2, 2, width // 2, 2).transpose(0, 2, 1, 3)
    ordered = np.sort(blocks.reshape(height // 2, width // 2, 4), axis=-1)
    holes = np.count_nonzero(ordered == 0, axis=-1)
    middle = np.minimum(holes + (3 - holes) // 2, 3)
    return np.ascontiguousarray(np.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0])
