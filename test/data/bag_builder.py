"""Builds small ROS bags of any storage out of images, camera infos and transforms."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from data.synthetic_frames import depth_mm
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame

COLOR = "/camera/camera/color/image_raw"
COLOR_INFO = "/camera/camera/color/camera_info"
ALIGNED_DEPTH = "/camera/camera/aligned_depth_to_color/image_raw"
ALIGNED_DEPTH_INFO = "/camera/camera/aligned_depth_to_color/camera_info"
DEPTH = "/camera/camera/depth/image_rect_raw"
DEPTH_INFO = "/camera/camera/depth/camera_info"
COLOR_FRAME = "camera_color_optical_frame"
DEPTH_FRAME = "camera_depth_optical_frame"
EXTRINSICS = "realsense2_camera_msgs/msg/Extrinsics"

Storage = Literal["folder", "mcap", "db3", "bag"]


class BagBuilder:
    """Collects messages, then writes them in the order of their recording."""

    def __init__(self, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        definition = "float64[9] rotation\nfloat64[3] translation\n"
        self.store.register(get_types_from_msg(definition, EXTRINSICS))
        self.messages: list[tuple[int, str, str, Any]] = []

    def add(self, topic: str, kind: str, recorded_ns: int, **fields: Any) -> None:
        """Add a message of a type `package/msg/Name` recorded at a time."""
        message = self.store.types[kind](**fields)
        self.messages.append((recorded_ns, topic, kind, message))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self.store.types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
        fields = {"stamp": stamp, "frame_id": frame_id} | ({"seq": 0} if self.ros1 else {})
        return self.store.types["std_msgs/msg/Header"](**fields)

    def image(
        self,
        topic: str,
        stamp_ns: int,
        pixels: np.ndarray,
        encoding: str,
        frame_id: str = COLOR_FRAME,
        recorded_ns: int | None = None,
        is_bigendian: int = 0,
        padding: int = 0,
    ) -> None:
        """Add an Image; `padding` bytes follow every row."""
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=255)
        self.add(
            topic,
            "sensor_msgs/msg/Image",
            stamp_ns if recorded_ns is None else recorded_ns,
            header=self.header(stamp_ns, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=is_bigendian,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )

    def compressed(
        self, topic: str, stamp_ns: int, description: str, data: bytes, frame_id: str = COLOR_FRAME
    ) -> None:
        """Add a CompressedImage."""
        self.add(
            topic,
            "sensor_msgs/msg/CompressedImage",
            stamp_ns,
            header=self.header(stamp_ns, frame_id),
            format=description,
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(
        self,
        topic: str,
        stamp_ns: int,
        camera: PinholeCamera,
        frame_id: str = COLOR_FRAME,
        k: np.ndarray | None = None,
        d: tuple[float, ...] = (0.0,) * 5,
    ) -> None:
        """Add a CameraInfo; `k` replaces the camera's matrix."""
        k = camera.matrix if k is None else k
        arrays = {
            "d": np.array(d),
            "k": k.reshape(-1),
            "r": np.eye(3).reshape(-1),
            "p": np.hstack([k, np.zeros((3, 1))]).reshape(-1),
        }
        if self.ros1:
            arrays = {key.upper(): value for key, value in arrays.items()}
        roi = self.store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        self.add(
            topic,
            "sensor_msgs/msg/CameraInfo",
            stamp_ns,
            header=self.header(stamp_ns, frame_id),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **arrays,
        )

    def static_transform(
        self, stamp_ns: int, parent: str, child: str, pose: se3.Pose, topic: str = "/tf_static"
    ) -> None:
        """Add T_parent_child."""
        types = self.store.types
        transform = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*pose[:3, 3]),
            rotation=types["geometry_msgs/msg/Quaternion"](*se3.to_quaternion(pose)),
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=self.header(stamp_ns, parent), child_frame_id=child, transform=transform
        )
        self.add(topic, "tf2_msgs/msg/TFMessage", stamp_ns, transforms=[stamped])

    def aligned_frame(self, frame: RgbdFrame) -> None:
        """Add a frame as realsense2_camera publishes it with align_depth."""
        stamp_ns = frame.stamp_ns
        self.camera_info(COLOR_INFO, stamp_ns, frame.camera)
        self.image(COLOR, stamp_ns, frame.color, "rgb8")
        self.camera_info(ALIGNED_DEPTH_INFO, stamp_ns, frame.camera)
        self.image(ALIGNED_DEPTH, stamp_ns, depth_mm(frame), "16UC1")

    def write(self, folder: Path, storage: Storage = "mcap") -> Path:
        """Write a bag into `folder`; returns the rosbag2 folder or the single file."""
        if storage == "bag":
            path = folder / "recording.bag"
            self._write(Ros1Writer(path), self.store.serialize_ros1)
            return path
        path = folder / "recording"
        plugin = StoragePlugin.SQLITE3 if storage == "db3" else StoragePlugin.MCAP
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
        self._write(writer, self.store.serialize_cdr)
        return path if storage == "folder" else path / f"recording.{storage}"

    def _write(self, writer: Any, serialize: Any) -> None:
        with writer:
            connections = {}
            for recorded_ns, topic, kind, message in sorted(
                self.messages, key=lambda entry: entry[0]
            ):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], recorded_ns, serialize(message, kind))


def aligned_bag(frames: list[RgbdFrame], folder: Path, storage: Storage = "mcap") -> Path:
    """Write frames as realsense2_camera with aligned depth records them."""
    builder = BagBuilder(ros1=storage == "bag")
    for frame in frames:
        builder.aligned_frame(frame)
    return builder.write(folder, storage)
