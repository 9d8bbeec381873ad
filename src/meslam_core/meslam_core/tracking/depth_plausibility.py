"""Whether a depth image can be one: its unit, its range, and that it measures anything."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import SensorConfig

# Where half of what an RGB-D camera measures indoors is.
PLAUSIBLE_MEDIAN_M = (0.35, 8.0)
MIN_MEASURED_SHARE = 0.005
# So many pixels apart are those that are looked at first.
STRIDE = 16
UNIT_REMEDY = (
    "a 16UC1 image must hold millimetres and a 32FC1 image metres (REP-118); for image files set "
    "depth_scale_m in camera.json"
)
_UNITS = {
    0.001: "these look like millimetres taken as metres",
    1000.0: "these look like metres taken as millimetres",
}

logger = logging.getLogger(__name__)


def is_stuck(depth_m: NDArray[np.float32]) -> bool:
    """Whether every measured pixel of a depth image (H, W) [m] has the same depth."""
    if _varies(depth_m[::STRIDE, ::STRIDE]):
        return False
    return bool((depth_m > 0).any()) and not _varies(depth_m)


def unusable_depth(depth_m: NDArray[np.float32], config: SensorConfig) -> str:
    """Why nothing can be done with a depth image, for people.

    Args:
        depth_m: (H, W) [m], stuck or with few pixels in range; 0 means no measurement.
        config: the range.
    """
    median_m = _median_m(depth_m)
    if median_m is None:
        return "too few pixels with depth: the depth image is empty"
    if is_stuck(depth_m):
        return f"every depth is {median_m:.4g} m: the depth camera or its driver is stuck"
    if config.min_depth_m <= median_m <= config.max_depth_m:
        return "too few pixels with depth, off depth edges"
    text = (
        f"too few pixels with depth from {config.min_depth_m:g} to {config.max_depth_m:g} m: the "
        f"median is {median_m:.3g} m"
    )
    doubt = _doubted_unit(median_m)
    return f"{text}; {doubt}" if doubt else text


def warn_of_depth(depth_m: NDArray[np.float32]) -> None:
    """Log what is unusual about the unit of a map's first depth image.

    Scale cannot be seen: a room whose depth is five times too small is a doll's house that is
    tracked perfectly. So the unusual is told, and the user decides.

    Args:
        depth_m: (H, W) [m]; 0 means no measurement.
    """
    median_m = _median_m(depth_m)
    doubt = "" if median_m is None else _doubted_unit(median_m)
    if doubt:
        logger.warning("the depth's median is %.3g m; %s", median_m, doubt)


def _doubted_unit(median_m: float) -> str:
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median_m <= high:
        return ""
    guesses = [text for unit, text in _UNITS.items() if low <= unit * median_m <= high]
    return f"{guesses[0] if guesses else 'is that its unit?'}: {UNIT_REMEDY}"


def _varies(depth_m: NDArray[np.float32]) -> bool:
    measured = depth_m[depth_m > 0]
    return len(measured) > 1 and bool(measured.min() < measured.max())


def _median_m(depth_m: NDArray[np.float32]) -> float | None:
    """Median of what was measured [m]; None where hardly anything was."""
    measured = depth_m[depth_m > 0]
    if len(measured) <= MIN_MEASURED_SHARE * depth_m.size:
        return None
    return float(np.median(measured))
