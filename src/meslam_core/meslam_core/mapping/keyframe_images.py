"""Reduced images of all keyframes, on disk, for those that see the same again much later."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame
from meslam_core.scratch import Record, ScratchFile

# Depths that differ by more than this share lie on different surfaces.
SAME_SURFACE = 0.03
DEPTH_UNIT_M = 0.0005


@dataclass(frozen=True)
class KeyframeImage:
    """What a later registration needs of a keyframe, in little memory.

    Attributes:
        gray: (H, W) uint8.
        depth: (H, W) uint16 in units of `DEPTH_UNIT_M`.
        camera: intrinsics of this resolution.
        stamp_ns: of the image [ns].
    """

    gray: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    camera: PinholeCamera
    stamp_ns: int

    @classmethod
    def of(cls, frame: RgbdFrame, width: int) -> KeyframeImage:
        """A frame's image, halved until it is at most `width` wide."""
        gray = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)
        depth, camera = np.nan_to_num(frame.depth_m, posinf=0.0, neginf=0.0), frame.camera
        while camera.width > width and min(camera.width, camera.height) > 16:
            half = (camera.width // 2, camera.height // 2)
            even = gray[: 2 * half[1], : 2 * half[0]]
            gray = np.asarray(cv2.resize(even, half, interpolation=cv2.INTER_AREA), np.uint8)
            depth = _halved_depth(depth[: 2 * half[1], : 2 * half[0]])
            camera = PinholeCamera(
                *half,
                camera.fx / 2,
                camera.fy / 2,
                (camera.cx - 0.5) / 2,
                (camera.cy - 0.5) / 2,
            )
        units = np.clip(np.rint(depth / DEPTH_UNIT_M), 0, np.iinfo(np.uint16).max)
        return cls(gray, units.astype(np.uint16), camera, frame.stamp_ns)

    def frame(self) -> RgbdFrame:
        """The image pair, without colours."""
        color = np.ascontiguousarray(np.broadcast_to(self.gray[..., None], (*self.gray.shape, 3)))
        depth_m = self.depth * np.float32(DEPTH_UNIT_M)
        return RgbdFrame(self.stamp_ns, color, depth_m, self.camera)


class KeyframeImages:
    """Images by the number of their keyframe; none of them stays in memory.

    Args:
        scratch: where they lie.
    """

    def __init__(self, scratch: ScratchFile) -> None:
        self._scratch = scratch
        self._entries: dict[int, tuple[Record, PinholeCamera, int]] = {}

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Of the keyframes that have an image, in the order they came."""
        return np.array(list(self._entries), np.int64)

    def add(self, keyframe: int, image: KeyframeImage) -> None:
        """Store the image of a keyframe.

        Raises:
            OutputError: when the disk does not take it.
        """
        record = self._scratch.put(image.gray.tobytes(), image.depth.tobytes())
        self._entries[keyframe] = record, image.camera, image.stamp_ns

    def get(self, keyframe: int) -> KeyframeImage:
        """The image of a keyframe.

        Raises:
            KeyError: it has none.
            OutputError: when the disk fails.
        """
        record, camera, stamp_ns = self._entries[keyframe]
        data, shape = self._scratch.get(record), (camera.height, camera.width)
        pixels = camera.height * camera.width
        gray = np.frombuffer(data, np.uint8, pixels).reshape(shape)
        depth = np.frombuffer(data, np.uint16, offset=pixels).reshape(shape)
        return KeyframeImage(gray, depth, camera, stamp_ns)


def _halved_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of each 2x2 block's depths on the nearest surface; 0 where there is none."""
    height, width = depth_m.shape
    corners = depth_m.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2)
    blocks = corners.reshape(height // 2, width // 2, 4)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=2, keepdims=True)
    same = (blocks > 0) & (blocks < nearest * (1.0 + SAME_SURFACE))
    count = same.sum(axis=2)
    return np.asarray((blocks * same).sum(axis=2) / np.maximum(count, 1), np.float32)
