"""ROS messages of sensors and poses to the core's types and back."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import depth_to_metres
from meslam_core.recordings.images import color_from_message, depth_from_message

NANOSECONDS = 1_000_000_000
MILLIMETRES = 1000.0
MAX_DEPTH_MM = 65535
# Farther away are neither robots nor their odometry's origins, not even in UTM coordinates.
MAX_POSITION_M = 1e8
MIN_NORM, MAX_NORM = 1e-3, 1e3


def stamp_ns(stamp: Time) -> int:
    """Nanoseconds of a message stamp."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def to_stamp(nanoseconds: int) -> Time:
    """Message stamp of nanoseconds."""
    seconds, rest = divmod(int(nanoseconds), NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def color_image(message: Image, topic: str) -> NDArray[np.uint8]:
    """RGB pixels (H, W, 3) uint8 of an image message, honouring its row step.

    Raises:
        FrameError: for an encoding that is not colour, or too little data; names the topic.
    """
    try:
        return color_from_message(message)
    except RecordingError as error:
        raise FrameError(f"{topic}: {error}") from error


def depth_image(message: Image, topic: str) -> NDArray[np.float32]:
    """Depth (H, W) float32 [m], 0 where unknown, of an image message (REP-118).

    Raises:
        FrameError: for an encoding that is not depth, or too little data; names the topic.
    """
    try:
        return depth_to_metres(depth_from_message(message))
    except (RecordingError, FrameError) as error:
        raise FrameError(f"{topic}: {error}") from error


def camera_from_info(message: CameraInfo, topic: str) -> PinholeCamera:
    """The pinhole camera of a camera_info's K.

    Raises:
        FrameError: when K is all zero or otherwise unusable; names the topic.
    """
    k = message.k
    if not np.any(k):
        raise FrameError(
            f"{topic}: K is all zero, so the camera is not calibrated; publish a camera_info "
            "with intrinsics"
        )
    try:
        return PinholeCamera(message.width, message.height, k[0], k[4], k[2], k[5])
    except FrameError as error:
        raise FrameError(f"{topic}: {error}") from error


def camera_to_info(camera: PinholeCamera, stamp: Time, frame_id: str) -> CameraInfo:
    """A camera_info of an undistorted camera."""
    message = CameraInfo(
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=camera.matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1),
    )
    message.header.stamp, message.header.frame_id = stamp, frame_id
    return message


def color_message(color: NDArray[np.uint8], stamp: Time, frame_id: str) -> Image:
    """An rgb8 image of pixels (H, W, 3)."""
    return image_message(color, "rgb8", stamp, frame_id)


def depth_message(depth_m: NDArray[np.float32], encoding: str, stamp: Time, frame_id: str) -> Image:
    """A depth image, `16UC1` in millimetres or `32FC1` in metres, of depth (H, W) [m]."""
    if encoding == "32FC1":
        return image_message(depth_m.astype("<f4"), encoding, stamp, frame_id)
    millimetres = np.rint(depth_m * MILLIMETRES)
    millimetres[millimetres > MAX_DEPTH_MM] = 0
    return image_message(millimetres.astype("<u2"), "16UC1", stamp, frame_id)


def image_message(pixels: NDArray[Any], encoding: str, stamp: Time, frame_id: str) -> Image:
    """An image message of pixels (H, W) or (H, W, channels) as they are."""
    message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    message.header.stamp, message.header.frame_id = stamp, frame_id
    message.step = pixels.nbytes // pixels.shape[0]
    message.data = byte_array(np.ascontiguousarray(pixels))
    return message


def byte_array(data: Any) -> array.array:
    """Bytes as the type that rclpy takes without looking at each of them."""
    result = array.array("B")
    result.frombytes(memoryview(data).cast("B"))
    return result


def numbers(code: str, values: NDArray[Any]) -> array.array:
    """Numbers of a type code of `array` as the type that rclpy takes without looking at each."""
    result = array.array(code)
    result.frombytes(np.ascontiguousarray(values, np.dtype(code)).tobytes())
    return result


def to_pose(T: se3.Pose) -> Pose:
    """A pose message of a (4, 4) pose [m]."""
    return Pose(position=_point(T), orientation=_quaternion(T))


def to_poses(T: NDArray[np.float64]) -> list[Pose]:
    """Pose messages of (N, 4, 4) poses [m]; much faster than one by one."""
    if not len(T):
        return []
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return [
        Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        for (x, y, z), (qx, qy, qz, qw) in zip(
            T[:, :3, 3].tolist(), quaternions.tolist(), strict=True
        )
    ]


def from_pose(message: Pose) -> se3.Pose:
    """The (4, 4) pose [m] of a message; a quaternion of zeros, the default, is no rotation.

    Raises:
        FrameError: when the numbers are no pose.
    """
    p, q = message.position, message.orientation
    return _checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def from_transform(message: Transform) -> se3.Pose:
    """The (4, 4) pose [m] of a transform.

    Raises:
        FrameError: when the numbers are no pose.
    """
    p, q = message.translation, message.rotation
    return _checked_pose((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def to_transform(T: se3.Pose, stamp: Time, parent: str, child: str) -> TransformStamped:
    """The transform message of T_parent_child (4, 4) [m]."""
    position = _point(T)
    message = TransformStamped(
        child_frame_id=child,
        transform=Transform(
            translation=Vector3(x=position.x, y=position.y, z=position.z),
            rotation=_quaternion(T),
        ),
    )
    message.header.stamp, message.header.frame_id = stamp, parent
    return message


def _checked_pose(position: tuple[float, ...], quaternion: tuple[float, ...]) -> se3.Pose:
    if not any(quaternion):
        quaternion = (0.0, 0.0, 0.0, 1.0)
    # Comparisons with not-a-number are false.
    near = all(abs(value) <= MAX_POSITION_M for value in position)
    if not near or not MIN_NORM <= math.hypot(*quaternion) <= MAX_NORM:
        raise FrameError(
            f"position {position} m and quaternion {quaternion} are no pose; give finite numbers"
        )
    return se3.from_quaternion(np.array(position), np.array(quaternion))


def _point(T: se3.Pose) -> Point:
    return Point(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))


def _quaternion(T: se3.Pose) -> Quaternion:
    x, y, z, w = (float(value) for value in se3.to_quaternion(T))
    return Quaternion(x=x, y=y, z=z, w=w)
