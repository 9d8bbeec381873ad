"""Folders with `color/`, `depth/`, `camera.json` and optionally `timestamps.txt`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.input_file import read_file
from meslam_core.recordings.image_files import (
    MAX_LIST_BYTES,
    CameraFile,
    ImageFileRecording,
    ImagePair,
)
from meslam_core.recordings.pairing import ordered_pairs
from meslam_core.trajectory import parsed_stamp

MILLIMETRE_M = 0.001
_IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff"})


def is_folder(path: Path) -> bool:
    """Whether a folder has `color/` and `depth/`."""
    return (path / "color").is_dir() and (path / "depth").is_dir()


def open_folder(path: Path, camera: PinholeCamera | None = None) -> ImageFileRecording:
    """Open a folder; the n-th colour image belongs to the n-th depth image.

    Args:
        path: folder with `color/`, `depth/` (files in the natural order of their names),
            `camera.json` (intrinsics, `depth_scale_m`, by default millimetres, and `fps`), and
            optionally `timestamps.txt` (seconds, one line a pair; without it `fps` counts).
        camera: intrinsics that replace those of `camera.json`.

    Raises:
        RecordingError: when files are missing or do not fit each other.
    """
    file = path / "camera.json"
    described = CameraFile.read(file) if camera is None or file.exists() else None
    color, depth = _images(path / "color"), _images(path / "depth")
    if not color and not depth:
        raise RecordingError(
            f"{path} has no images in color/ and depth/; put pairs of the same order there"
        )
    if len(color) != len(depth):
        raise RecordingError(
            f"{path} has {len(color)} images in color/ and {len(depth)} in depth/; "
            "every colour image needs its depth image, in the same order"
        )
    stamps_ns = _stamps(path, len(color), described.fps if described else None)
    pairs = [
        ImagePair(int(stamps_ns[first]), color[first], depth[first])
        for first, _ in ordered_pairs(path.name, stamps_ns, stamps_ns)
    ]
    chosen = camera or (described.camera if described else None)
    assert chosen is not None
    scale_m = described.depth_scale_m if described else None
    return ImageFileRecording(
        path, "colour and depth folder", chosen, scale_m or MILLIMETRE_M, pairs
    )


def _images(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_SUFFIXES]
    return sorted((file for file in files if not file.name.startswith(".")), key=_natural_order)


def _natural_order(file: Path) -> list[tuple[int, int, str]]:
    """Key that puts `2.png` before `10.png`."""
    parts = re.split(r"([0-9]+)", file.name)
    return [(0, int(part), "") if i % 2 else (1, 0, part) for i, part in enumerate(parts) if part]


def _stamps(path: Path, count: int, fps: float | None) -> NDArray[np.int64]:
    file = path / "timestamps.txt"
    if not file.exists():
        if fps is None:
            raise RecordingError(
                f"{path} tells no time: add `fps` to camera.json, or a timestamps.txt with one "
                "line of seconds a pair"
            )
        return np.array([round(number * 1e9 / fps) for number in range(count)], np.int64)
    try:
        lines = read_file(file, MAX_LIST_BYTES).decode().splitlines()
        stamps = [parsed_stamp(line) for line in lines if line.strip() and not line.startswith("#")]
    except (OSError, ValueError) as error:
        raise RecordingError(f"{file} is not one number of seconds a line: {error}") from error
    if len(stamps) != count:
        raise RecordingError(
            f"{file} has {len(stamps)} stamps for {count} pairs of images; write one line a pair"
        )
    return np.array(stamps, np.int64)
