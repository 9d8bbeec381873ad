"""Which pixels of a frame are trusted, and a random choice among them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.config import SensorConfig
from meslam_core.frame import RgbdFrame

# Images are gone through in bands of so many pixels: memory for larger ones comes from the
# system anew for every frame, which takes longer than what is computed in it.
BAND_PIXELS = 80_000
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
    height, width = depth_m.shape
    rows = max(1, BAND_PIXELS // max(width, 1))
    trusted = np.empty(depth_m.shape, np.bool_)
    for first in range(0, height, rows):
        above = max(first - 1, 0)
        band = _trusted_band(depth_m[above : first + rows + 1], config)
        trusted[first : first + rows] = band[first - above :][:rows]
    return trusted


def _trusted_band(depth_m: NDArray[np.float32], config: SensorConfig) -> NDArray[np.bool_]:
    """`trusted_pixels` of some rows."""
    # OpenCV's limit is exclusive.
    below = float(np.nextafter(np.float32(config.min_depth_m), np.float32(0.0)))
    valid = cv2.threshold(depth_m, below, 0.0, cv2.THRESH_TOZERO)[1]
    cv2.threshold(valid, config.max_depth_m, 0.0, cv2.THRESH_TOZERO_INV, dst=valid)
    cv2.patchNaNs(valid, 0.0)
    limit = valid * np.float32(config.edge_threshold)
    farthest = cv2.dilate(valid, NEIGHBOURS)
    filled = cv2.threshold(valid, 0.0, NO_DEPTH, cv2.THRESH_BINARY_INV)[1]
    cv2.max(filled, valid, dst=filled)
    nearest = cv2.erode(filled, NEIGHBOURS, dst=valid)
    # Where a pixel has no depth the limit is 0, and no span is below it.
    span = cv2.absdiff(farthest, nearest, dst=farthest)
    band: NDArray[np.bool_] = span < limit
    return band


def choose_pixels(
    mask: NDArray[np.bool_], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of at most `count` pixels of a mask, without repetition."""
    return TrustedPixels(mask).choose(count, generator)


def usable_share(frame: RgbdFrame, config: SensorConfig) -> float:
    """Share of a frame's pixels that have depth in range."""
    depth = frame.depth_m
    return float(np.mean((depth >= config.min_depth_m) & (depth <= config.max_depth_m)))
