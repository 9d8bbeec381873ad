"""Where the depth camera sits relative to the colour camera, as a bag tells it."""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import Any

import numpy as np

from meslam_core import se3
from meslam_core.errors import RecordingError
from meslam_core.recordings.messages import MessageSource

_TF_TYPE = "tf2_msgs/msg/TFMessage"
_EXTRINSICS_TYPE = "realsense2_camera_msgs/msg/Extrinsics"
_TF_MESSAGES_SEARCHED = 2000
"""Static frames of ROS 1 bags are repeated on /tf, at least once a second."""
MAX_FRAMES = 2000
"""Further frames are passed over: no robot has so many, and whoever sends them takes memory."""


def depth_to_color(source: MessageSource, depth_frame: str, color_frame: str) -> se3.Pose:
    """T_color_depth (4, 4) [m], from the frames of /tf_static or librealsense's extrinsics.

    Raises:
        RecordingError: when the bag holds neither.
    """
    depth_frame, color_frame = depth_frame.lstrip("/"), color_frame.lstrip("/")
    if depth_frame == color_frame:
        return np.eye(4)
    tree = FrameTree()
    for topic in ("/tf_static", "/tf"):
        if source.types.get(topic) not in (_TF_TYPE, "tf/msg/tfMessage"):
            continue
        for _, _, raw in islice(source.messages([topic]), _TF_MESSAGES_SEARCHED):
            tree.add(source.deserialize(raw, topic))
        found = tree.lookup(target=color_frame, origin=depth_frame)
        if found is not None:
            return found
    extrinsics = _realsense_extrinsics(source)
    if extrinsics is not None:
        return extrinsics
    raise RecordingError(
        f"depth is in the frame {depth_frame!r} and colour in {color_frame!r}, but the recording "
        "has no transform between them; record /tf_static too, or let the camera align depth to "
        "colour (align_depth.enable:=true) and record /camera/camera/aligned_depth_to_color"
    )


def _realsense_extrinsics(source: MessageSource) -> se3.Pose | None:
    """T_color_depth of realsense2_camera's latched topic `extrinsics/depth_to_color`."""
    for topic, message_type in source.types.items():
        if message_type != _EXTRINSICS_TYPE or not topic.endswith("/depth_to_color"):
            continue
        for _, _, raw in source.messages([topic]):
            # Nine numbers of the rotation, column by column, and three of the translation end the
            # message; only older drivers begin it with a header.
            numbers = np.frombuffer(raw[-12 * 8 :], "<f8")
            pose = np.eye(4)
            pose[:3, :3] = numbers[:9].reshape(3, 3).T
            pose[:3, 3] = numbers[9:]
            return pose
    return None


class FrameTree:
    """Fixed transforms between named frames, of which there are at most `MAX_FRAMES`."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, se3.Pose]] = {}

    def add(self, message: Any) -> None:
        """Add the transforms of a TFMessage."""
        for transform in message.transforms:
            parent = transform.header.frame_id.lstrip("/")
            child = transform.child_frame_id.lstrip("/")
            position, rotation = transform.transform.translation, transform.transform.rotation
            quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
            translation = np.array([position.x, position.y, position.z])
            usable = np.isfinite(translation).all() and 0 < np.linalg.norm(quaternion) < np.inf
            new = {parent, child} - self._neighbours.keys()
            if not usable or len(self._neighbours) + len(new) > MAX_FRAMES:
                continue
            T_parent_child = se3.from_quaternion(translation, quaternion)
            self._neighbours.setdefault(parent, {})[child] = T_parent_child
            self._neighbours.setdefault(child, {})[parent] = se3.inverse(T_parent_child)

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    def lookup(self, target: str, origin: str) -> se3.Pose | None:
        """T_target_origin (4, 4), or None when the frames are not connected."""
        reached = {target: np.eye(4)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            if frame == origin:
                return reached[frame]
            for neighbour, T_frame_neighbour in self._neighbours.get(frame, {}).items():
                if neighbour not in reached:
                    reached[neighbour] = reached[frame] @ T_frame_neighbour
                    queue.append(neighbour)
        return None
