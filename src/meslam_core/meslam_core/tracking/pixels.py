"""Which pixels of a frame are trusted, and a random choice among them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.config import SensorConfig
from meslam_core.frame import RgbdFrame

# Images are gone through in bands of so many pixels, in the same memory: more of it would come
# from the system anew for every frame, which takes longer than what is computed in it.
BAND_PIXELS = 25_000
# Stands for holes where the nearest depth is sought.
NO_DEPTH = 1e9
NEIGHBOURS = np.ones((3, 3), np.uint8)


class TrustedPixels:
    """A frame's trusted pixels, from which one may choose several times.

    Args:
        mask: (H, W) bool.
    """

    def __init__(self, mask: NDArray[np.bool_]) -> None:
        self._flat = np.flatnonzero(mask)
        self._width = mask.shape[1]

    def __len__(self) -> int:
        return len(self._flat)

    def choose(
        self, count: int, generator: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of at most `count` of the pixels, without repetition."""
        flat = self._flat
        if len(flat) > count:
            flat = generator.choice(flat, count, replace=False, shuffle=False)
        return flat // self._width, flat % self._width


def trusted_pixels(depth_m: NDArray[np.float32], config: SensorConfig) -> NDArray[np.bool_]:
    """Mask (H, W) of pixels with depth in range and off depth edges.

    A pixel lies on an edge when the depth within its 3x3 neighbourhood, holes left out, spans
    more than `edge_threshold` of its own.
    """
    depth_m = np.asarray(depth_m, np.float32)
    height, width = depth_m.shape
    rows = max(1, BAND_PIXELS // max(width, 1))
    trusted = np.empty(depth_m.shape, np.bool_)
    scratch = np.empty((4, rows + 2, width), np.float32)
    for first in range(0, height, rows):
        above, end = max(first - 1, 0), min(first + rows, height)
        band = depth_m[above : end + 1]
        span, limit = _spans(band, config, scratch[:, : len(band)])
        inner = slice(first - above, end - above)
        np.less(span[inner], limit[inner], out=trusted[first:end])
    return trusted


def _spans(
    depth_m: NDArray[np.float32], config: SensorConfig, scratch: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far depth spans about the pixels of some rows, and what it may; in `scratch`."""
    valid, filled, farthest, limit = scratch
    # OpenCV's limit is exclusive.
    below = float(np.nextafter(np.float32(config.min_depth_m), np.float32(0.0)))
    cv2.threshold(depth_m, below, 0.0, cv2.THRESH_TOZERO, dst=valid)
    cv2.threshold(valid, config.max_depth_m, 0.0, cv2.THRESH_TOZERO_INV, dst=valid)
    cv2.patchNaNs(valid, 0.0)
    np.multiply(valid, np.float32(config.edge_threshold), out=limit)
    cv2.dilate(valid, NEIGHBOURS, dst=farthest)
    cv2.threshold(valid, 0.0, NO_DEPTH, cv2.THRESH_BINARY_INV, dst=filled)
    cv2.max(filled, valid, dst=filled)
    nearest = cv2.erode(filled, NEIGHBOURS, dst=valid)
    # Where a pixel has no depth its limit is 0, and no span is below it.
    cv2.absdiff(farthest, nearest, dst=farthest)
    return farthest, limit


def choose_pixels(
    mask: NDArray[np.bool_], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of at most `count` pixels of a mask, without repetition."""
    return TrustedPixels(mask).choose(count, generator)


def usable_share(frame: RgbdFrame, config: SensorConfig) -> float:
    """Share of a frame's pixels that have depth in range."""
    depth = frame.depth_m
    return float(np.mean((depth >= config.min_depth_m) & (depth <= config.max_depth_m)))
