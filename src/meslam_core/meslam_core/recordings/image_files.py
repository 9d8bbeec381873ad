"""Recordings whose images are files, whatever lists them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import RgbdFrame, depth_to_metres
from meslam_core.input_file import read_file
from meslam_core.recordings.images import decode_color, decode_depth

T = TypeVar("T")

MAX_IMAGE_BYTES = 1 << 28
MAX_LIST_BYTES = 1 << 26
# Of the numbers in a camera.json: whatever is beyond is a mistake.
LEAST, MOST = 1e-9, 1e9


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
        return decode(read_file(path, MAX_IMAGE_BYTES))
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
            camera, values = PinholeCamera.described(path)
        except FrameError as error:
            raise RecordingError(str(error)) from error
        if not values.get("depth_aligned_to_color", True):
            raise RecordingError(
                f"{path} says that depth is not aligned to colour; register the depth images first"
            )
        return cls(
            camera,
            _positive(path, values, "depth_scale_m"),
            _positive(path, values, "fps"),
        )


def listed_file(folder: Path, name: str) -> Path:
    """A file that a list in a folder names.

    Raises:
        ValueError: when the name leads out of the folder.
    """
    if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise ValueError(f"{name!r} leads out of the folder")
    return folder / name


def _positive(path: Path, values: dict[str, Any], key: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, int | float) and LEAST <= value <= MOST:
        return float(value)
    raise RecordingError(f"{path}: {key} is {value!r}, expected a positive number")
