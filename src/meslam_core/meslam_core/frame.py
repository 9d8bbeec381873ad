"""One colour image and the depth image registered to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError


@dataclass(frozen=True)
class RgbdFrame:
    """A colour image and its depth, seen by one camera at one instant.

    Attributes:
        stamp_ns: time of the image [ns].
        color: (H, W, 3) uint8, RGB.
        depth_m: (H, W) float32 along the optical axis [m]; 0 means no measurement.
        camera: intrinsics shared by both images.

    Raises:
        FrameError: when shapes, dtypes and camera do not fit each other.
    """

    stamp_ns: int
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    camera: PinholeCamera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.color.shape != (*size, 3) or self.color.dtype != np.uint8:
            raise FrameError(
                f"colour image is {self.color.dtype} {self.color.shape}, expected uint8 "
                f"{(*size, 3)} as the camera intrinsics say"
            )
        if self.depth_m.shape != size or self.depth_m.dtype != np.float32:
            raise FrameError(
                f"depth image is {self.depth_m.dtype} {self.depth_m.shape}, expected float32 "
                f"{size}; depth must be registered to colour"
            )

    @property
    def stamp_s(self) -> float:
        """Time of the image [s]."""
        return self.stamp_ns * 1e-9


def depth_to_metres(raw: NDArray[Any], scale_m: float = 0.001) -> NDArray[np.float32]:
    """Depth image in metres with every unusable value set to 0.

    Args:
        raw: (H, W) uint16 in units of `scale_m`, or float32/float64 in metres (REP-118).
        scale_m: length of one unit of an integer image [m].

    Raises:
        FrameError: for any other shape or dtype.
    """
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32, np.float64):
        raise FrameError(
            f"depth image is {raw.dtype} {raw.shape}; expected (H, W) uint16 or floating point"
        )
    if raw.dtype == np.uint16:
        return raw.astype(np.float32) * np.float32(scale_m)
    depth_m = raw.astype(np.float32)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m
