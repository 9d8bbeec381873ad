"""Opens a recording of any known format."""

from __future__ import annotations

from pathlib import Path

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.recordings.folder import is_folder, open_folder
from meslam_core.recordings.librealsense import LibrealsenseRecording, is_librealsense
from meslam_core.recordings.messages import MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC, open_source
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.ros_bag import RosBagRecording
from meslam_core.recordings.topics import RecordingTopics
from meslam_core.recordings.tum import is_tum, open_tum

_ACCEPTED = (
    "a rosbag2 folder, an .mcap, .db3 or .bag file, a TUM folder (rgb.txt, depth.txt), "
    "or a folder with color/, depth/ and camera.json"
)
_SUFFIXES = {MCAP_MAGIC: ".mcap", SQLITE_MAGIC: ".db3", ROS1_MAGIC: ".bag"}


def open_recording(
    path: Path, camera: PinholeCamera | None = None, topics: RecordingTopics | None = None
) -> Recording:
    """Open a recording; its content tells the format.

    Args:
        path: file or folder.
        camera: intrinsics of the colour camera that replace, or make up for, the recording's.
        topics: topics of a ROS bag, where the detected ones are not those wanted.

    Raises:
        RecordingError: when there is no recording, it is damaged, or lacks colour, depth or
            intrinsics; the message says what to do.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise RecordingError(f"{path} does not exist; expected {_ACCEPTED}")
        if not path.is_dir() and not path.is_file():
            # A pipe would be waited for, and a device has no end.
            raise RecordingError(f"{path} is no file and no folder; expected {_ACCEPTED}")
        if path.is_dir() and is_tum(path):
            return open_tum(path, camera)
        if path.is_dir() and is_folder(path):
            return open_folder(path, camera)
        _check_is_bag(path)
        return _open_bag(path, camera, topics)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error


def _open_bag(
    path: Path, camera: PinholeCamera | None, topics: RecordingTopics | None
) -> Recording:
    source = open_source(path)
    try:
        if is_librealsense(source) and path.is_file():
            return LibrealsenseRecording(path, source, camera)
        return RosBagRecording(path, source, camera, topics)
    except BaseException:
        source.close()
        raise


def _check_is_bag(path: Path) -> None:
    """Raise unless a file or folder looks like a ROS bag."""
    if path.is_dir():
        patterns = ("metadata.yaml", "*.mcap", "*.db3")
        if not any(file for pattern in patterns for file in path.glob(pattern)):
            raise RecordingError(f"{path} is not a recording; expected {_ACCEPTED}")
        return
    with path.open("rb") as stream:
        start = stream.read(16)
    if not start:
        raise RecordingError(f"{path} is empty; record it again")
    for magic, suffix in _SUFFIXES.items():
        if start.startswith(magic):
            if path.suffix != suffix:
                raise RecordingError(
                    f"{path} is a {suffix} file by its content; rename it to "
                    f"{path.with_suffix(suffix).name}"
                )
            return
    raise RecordingError(
        f"{path} is not a recording, or its beginning is damaged; expected {_ACCEPTED}"
    )
