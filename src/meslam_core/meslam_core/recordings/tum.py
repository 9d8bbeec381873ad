"""Folders of the TUM RGB-D benchmark: `rgb.txt`, `depth.txt` and the images they list."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.input_file import read_file
from meslam_core.recordings.image_files import (
    MAX_LIST_BYTES,
    CameraFile,
    ImageFileRecording,
    ImagePair,
    listed_file,
)
from meslam_core.recordings.pairing import ordered_pairs
from meslam_core.trajectory import parsed_stamp

DEPTH_SCALE_M = 1.0 / 5000.0
"""Length of one unit of the benchmark's depth images [m]."""

# fx, fy, cx, cy of the benchmark's three Kinects and ROS's default:
# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
_FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
_ROS_DEFAULT = (525.0, 525.0, 319.5, 239.5)
_IMAGE_SIZE = (640, 480)

logger = logging.getLogger(__name__)


def is_tum(path: Path) -> bool:
    """Whether a folder has the benchmark's lists."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def open_tum(path: Path, camera: PinholeCamera | None = None) -> ImageFileRecording:
    """Open a folder of the benchmark; images are paired as its `associate.py` does.

    Args:
        path: folder with `rgb.txt` and `depth.txt`.
        camera: intrinsics; by default those of `camera.json` in the folder, else the published
            ones by the freiburg number in the folder's name.

    Raises:
        RecordingError: when a list is damaged, or nothing can be paired.
    """
    file = path / "camera.json"
    described = CameraFile.read(file) if file.exists() else None
    if camera is None:
        camera = described.camera if described else _published_camera(path)
    scale_m = described.depth_scale_m if described else None
    color_ns, color_files = _read_list(path / "rgb.txt")
    depth_ns, depth_files = _read_list(path / "depth.txt")
    pairs = [
        ImagePair(int(color_ns[color]), color_files[color], depth_files[depth])
        for color, depth in ordered_pairs(path.name, color_ns, depth_ns)
    ]
    return ImageFileRecording(path, "TUM folder", camera, scale_m or DEPTH_SCALE_M, pairs)


def _read_list(path: Path) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], list[Path]]:
    stamps, files = [], []
    try:
        lines = read_file(path, MAX_LIST_BYTES).decode().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            stamp, name = fields
            stamps.append(parsed_stamp(stamp))
            files.append(listed_file(path.parent, name))
        except ValueError as error:
            raise RecordingError(
                f"{path}, line {number}: expected `seconds file`, found {line!r} ({error})"
            ) from error
    return np.array(stamps, np.int64), files


def _published_camera(path: Path) -> PinholeCamera:
    found = re.search(r"(?:freiburg|fr)([123])(?!\d)", path.resolve().name, re.IGNORECASE)
    if found is None:
        logger.warning(
            "%s: neither a camera.json nor a freiburg number in the name; using ROS's default "
            "intrinsics fx = fy = 525, cx = 319.5, cy = 239.5",
            path.name,
        )
    fx, fy, cx, cy = _FREIBURG[found[1]] if found else _ROS_DEFAULT
    return PinholeCamera(*_IMAGE_SIZE, fx=fx, fy=fy, cx=cx, cy=cy)
