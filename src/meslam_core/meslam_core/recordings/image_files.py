"""Recordings whose images are files, whatever lists them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import RgbdFrame, depth_to_metres
from meslam_core.recordings.images import decode_color, decode_depth

T = TypeVar("T")


@dataclass(frozen=True)
class ImagePair:
    """Files of one frame and its stamp [ns]."""

    stamp_ns: int
    color: Path
    depth: Path


class ImageFileRecording:
    """Colour and registered depth images in files; only those asked for are read."""

    def __init__(
        self,
        path: Path,
        format_name: str,
        camera: PinholeCamera,
        depth_scale_m: float,
        pairs: list[ImagePair],
    ) -> None:
        """Take an index of files.

        Args:
            path: the folder.
            format_name: for people.
            camera: intrinsics of all images.
            depth_scale_m: length of one unit of an integer depth image [m].
            pairs: in the order of their stamps.
        """
        self.name = path.name
        self.path = path
        self.format = format_name
        self.topics: dict[str, str] = {}
        self._camera = camera
        self._depth_scale_m = depth_scale_m
        self._pairs = pairs

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of both images."""
        return self._camera

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the pairs [ns], increasing."""
        return np.array([pair.stamp_ns for pair in self._pairs], np.int64)

    def __len__(self) -> int:
        return len(self._pairs)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """Decode the pairs `start:stop:step`; see `Recording.frames`."""
        for pair in self._pairs[start:stop:step]:
            color = _decoded(pair.color, decode_color)
            depth = _decoded(pair.depth, decode_depth)
            try:
                depth_m = depth_to_metres(depth, self._depth_scale_m)
                frame = RgbdFrame(pair.stamp_ns, color, depth_m, self._camera)
            except FrameError as error:
                raise RecordingError(f"{pair.color} and {pair.depth}: {error}") from error
            yield frame

    def close(self) -> None:
        """Nothing stays open between frames."""


def _decoded(path: Path, decode: Callable[[bytes], T]) -> T:
    try:
        return decode(path.read_bytes())
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


@dataclass(frozen=True)
class CameraFile:
    """What a recording's `camera.json` may say besides the intrinsics."""

    camera: PinholeCamera
    depth_scale_m: float | None
    fps: float | None

    @classmethod
    def read(cls, path: Path) -> CameraFile:
        """Read a `camera.json`.

        Raises:
            RecordingError: when it is unreadable, or depth is not registered to colour.
        """
        try:
            camera = PinholeCamera.from_json(path)
        except FrameError as error:
            raise RecordingError(str(error)) from error
        values: dict[str, Any] = json.loads(path.read_text())
        if not values.get("depth_aligned_to_color", True):
            raise RecordingError(
                f"{path} says that depth is not aligned to colour; register the depth images first"
            )
        return cls(
            camera,
            _positive(path, values, "depth_scale_m"),
            _positive(path, values, "fps"),
        )


def _positive(path: Path, values: dict[str, Any], key: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, int | float) and math.isfinite(value) and value > 0:
        return float(value)
    raise RecordingError(f"{path}: {key} is {value!r}, expected a positive number")


def parse_stamp_ns(text: str) -> int:
    """A decimal number of seconds as nanoseconds, without the rounding of a float.

    Raises:
        ValueError: when the text is not a finite number.
    """
    try:
        stamp_ns = int((Decimal(text) * 1_000_000_000).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f"{text!r} is not a number of seconds") from error
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"{text!r} seconds are out of range")
    return stamp_ns
