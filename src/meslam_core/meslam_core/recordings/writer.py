"""Writes recordings as rosbag2-compatible mcap files, as realsense2_camera would record them."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from meslam_core.errors import OutputError, RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings.recording import Recording

COLOR_TOPIC = "/camera/camera/color/image_raw"
COLOR_INFO_TOPIC = "/camera/camera/color/camera_info"
DEPTH_TOPIC = "/camera/camera/aligned_depth_to_color/image_raw"
DEPTH_INFO_TOPIC = "/camera/camera/aligned_depth_to_color/camera_info"
STATIC_TRANSFORMS_TOPIC = "/tf_static"

BASE_FRAME = "camera_link"
COLOR_FRAME = "camera_color_frame"
OPTICAL_FRAME = "camera_color_optical_frame"

DepthEncoding = Literal["16UC1", "32FC1"]

_CHUNK_BYTES = 4 * 1024 * 1024
_IMAGE = "sensor_msgs/msg/Image"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_TF_MESSAGE = "tf2_msgs/msg/TFMessage"
_TYPES = {
    COLOR_TOPIC: _IMAGE,
    COLOR_INFO_TOPIC: _CAMERA_INFO,
    DEPTH_TOPIC: _IMAGE,
    DEPTH_INFO_TOPIC: _CAMERA_INFO,
    STATIC_TRANSFORMS_TOPIC: _TF_MESSAGE,
}
# From x forward, y left, z up to the optical frame's x right, y down, z forward (REP-103).
_OPTICAL_ROTATION = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}

# As rosbag2 writes it; without it a replayed /tf_static reaches only who listened in time.
_QOS = """\
- history: keep_last
  depth: {depth}
  reliability: reliable
  durability: {durability}
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""


class McapWriter:
    """Writes RGB-D frames to an .mcap file; a context manager.

    The file appears under its name when everything is written; on failure nothing is left behind.
    Messages are recorded at the time of their stamps.
    """

    def __init__(self, target: Path, depth_encoding: DepthEncoding = "16UC1") -> None:
        """Open a temporary file beside the target; its folder is made if need be.

        Args:
            target: name of the .mcap file; an existing one is replaced at the end.
            depth_encoding: 16UC1, millimetres up to 65.535 m, or 32FC1, metres without loss.

        Raises:
            OutputError: when the name is not an .mcap, or the folder cannot be written to.
        """
        self._target = Path(target)
        if self._target.suffix != ".mcap" or self._target.is_dir():
            raise OutputError(
                f"{target} is not a file name that ends in .mcap; choose one that does"
            )
        self._depth_encoding = depth_encoding
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._partial = self._target.with_name(f".{self._target.name}.{os.getpid()}.partial")
        self._last_stamp_ns: int | None = None
        self._stream = self._opened()
        try:
            self._writer = Writer(self._stream, _CHUNK_BYTES, CompressionType.ZSTD)
            self._writer.start(profile="ros2", library="meslam")
            self._channels = self._registered_channels()
        except OSError as error:
            self.discard()
            raise self._not_written(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if kind is None:
            self._finish()
        else:
            self.discard()

    def append(self, frame: RgbdFrame) -> None:
        """Write a frame.

        Raises:
            RecordingError: when its stamp is negative or not later than the previous one.
            OutputError: when the file cannot be written.
        """
        previous = self._last_stamp_ns
        if frame.stamp_ns < 0 or (previous is not None and frame.stamp_ns <= previous):
            raise RecordingError(
                f"frame stamp {frame.stamp_ns} ns does not follow {previous} ns; "
                "stamps must be positive and increase"
            )
        self._last_stamp_ns = frame.stamp_ns
        try:
            if previous is None:
                self._write(STATIC_TRANSFORMS_TOPIC, self._static_transforms(frame), frame)
            info = self._camera_info(frame)
            self._write(COLOR_INFO_TOPIC, info, frame)
            self._write(COLOR_TOPIC, self._image(frame, frame.color, "rgb8"), frame)
            self._write(DEPTH_INFO_TOPIC, info, frame)
            depth = self._image(frame, self._encoded_depth(frame.depth_m), self._depth_encoding)
            self._write(DEPTH_TOPIC, depth, frame)
        except OSError as error:
            raise self._not_written(error) from error

    def discard(self) -> None:
        """Remove what was written; the target stays as it was. Idempotent."""
        with suppress(OSError):
            self._stream.close()
        self._partial.unlink(missing_ok=True)

    def _opened(self) -> BinaryIO:
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            return self._partial.open("wb")
        except OSError as error:
            raise self._not_written(error) from error

    def _finish(self) -> None:
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            self._partial.replace(self._target)
        except OSError as error:
            self.discard()
            raise self._not_written(error) from error

    def _not_written(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._target} cannot be written: {error.strerror or error}; "
            "choose a folder that is writable and has space"
        )

    def _registered_channels(self) -> dict[str, int]:
        schemas = {}
        for name in sorted(set(_TYPES.values())):
            definition, _ = self._typestore.generate_msgdef(name, ros_version=2)
            schemas[name] = self._writer.register_schema(name, "ros2msg", definition.encode())
        channels = {}
        for topic, name in _TYPES.items():
            latched = topic == STATIC_TRANSFORMS_TOPIC
            durability = "transient_local" if latched else "volatile"
            metadata = {
                "offered_qos_profiles": _QOS.format(
                    depth=1 if latched else 5, durability=durability
                ),
                "topic_type_hash": self._typestore.hash_rihs01(name),
            }
            channels[topic] = self._writer.register_channel(topic, "cdr", schemas[name], metadata)
        return channels

    def _write(self, topic: str, message: Any, frame: RgbdFrame) -> None:
        raw = self._typestore.serialize_cdr(message, _TYPES[topic])
        self._writer.add_message(
            self._channels[topic], frame.stamp_ns, bytes(raw), publish_time=frame.stamp_ns
        )

    def _encoded_depth(self, depth_m: NDArray[np.float32]) -> NDArray[Any]:
        if self._depth_encoding == "32FC1":
            return depth_m
        millimetres: NDArray[np.float32] = np.rint(depth_m * np.float32(1000.0))
        millimetres[millimetres > np.iinfo(np.uint16).max] = 0
        return millimetres.astype(np.uint16)

    def _header(self, frame: RgbdFrame, frame_id: str = OPTICAL_FRAME) -> Any:
        types = self._typestore.types
        seconds, nanoseconds = divmod(frame.stamp_ns, 1_000_000_000)
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def _image(self, frame: RgbdFrame, pixels: NDArray[Any], encoding: str) -> Any:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        return self._typestore.types[_IMAGE](
            header=self._header(frame),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=data.size // height,
            data=data,
        )

    def _camera_info(self, frame: RgbdFrame) -> Any:
        types = self._typestore.types
        k = frame.camera.matrix
        return types[_CAMERA_INFO](
            header=self._header(frame),
            height=frame.camera.height,
            width=frame.camera.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=k.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.hstack([k, np.zeros((3, 1))]).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )

    def _static_transforms(self, frame: RgbdFrame) -> Any:
        types = self._typestore.types
        origin = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        unrotated = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        transforms = [
            types["geometry_msgs/msg/TransformStamped"](
                header=self._header(frame, parent),
                child_frame_id=child,
                transform=types["geometry_msgs/msg/Transform"](
                    translation=origin,
                    rotation=types["geometry_msgs/msg/Quaternion"](**rotation),
                ),
            )
            for parent, child, rotation in (
                (BASE_FRAME, COLOR_FRAME, unrotated),
                (COLOR_FRAME, OPTICAL_FRAME, _OPTICAL_ROTATION),
            )
        ]
        return types[_TF_MESSAGE](transforms=transforms)


def convert(
    recording: Recording,
    target: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    depth_encoding: DepthEncoding = "16UC1",
) -> int:
    """Write all frames of a recording to an .mcap file.

    Args:
        recording: the source.
        target: name of the .mcap file.
        progress: called with the number of frames written and their total.
        depth_encoding: see `McapWriter`.

    Returns:
        Number of frames written.

    Raises:
        RecordingError: when the source is damaged; then no file is written.
        OutputError: when the target cannot be written.
    """
    total = len(recording)
    with McapWriter(target, depth_encoding) as writer:
        for done, frame in enumerate(recording.frames(), start=1):
            writer.append(frame)
            progress(done, total)
    return total
