"""Which pixels of a frame are trusted, and a random choice among them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.config import SensorConfig
from meslam_core.frame import RgbdFrame


def trusted_pixels(depth_m: NDArray[np.float32], config: SensorConfig) -> NDArray[np.bool_]:
    """Mask (H, W) of pixels with depth in range and off depth edges.

    A pixel lies on an edge when the depth within its 3x3 neighbourhood, holes left out, spans
    more than `edge_threshold` of its own.
    """
    valid = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
    kernel = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(np.where(valid, depth_m, np.float32(0.0)), kernel)
    nearest = cv2.erode(np.where(valid, depth_m, np.float32(np.inf)), kernel)
    with np.errstate(invalid="ignore"):
        smooth = (farthest - nearest) < config.edge_threshold * depth_m
    return valid & smooth


def choose_pixels(
    mask: NDArray[np.bool_], count: int, generator: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of at most `count` pixels of a mask, without repetition."""
    flat = np.flatnonzero(mask)
    if len(flat) > count:
        flat = generator.choice(flat, count, replace=False, shuffle=False)
    return flat // mask.shape[1], flat % mask.shape[1]


def usable_share(frame: RgbdFrame, config: SensorConfig) -> float:
    """Share of a frame's pixels that have depth in range."""
    depth = frame.depth_m
    return float(np.mean((depth >= config.min_depth_m) & (depth <= config.max_depth_m)))
