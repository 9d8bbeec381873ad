"""The frames' tree: what /tf_static says, and what this system adds to /tf.

tf2_ros is not needed for the three things done here: collecting static transforms, looking up
the fixed chain between camera frames, and broadcasting.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from tf2_msgs.msg import TFMessage

from meslam_core import se3
from meslam_core.errors import FrameError
from meslam_core.recordings.transforms import FrameTree
from meslam_ros import topics
from meslam_ros.conversions import to_stamp, to_transform
from meslam_ros.qos import STREAM, describe, latched

STATIC_DEPTH = 100


class StaticTransforms:
    """Fixed transforms between frames, from /tf_static; may be asked from any thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._tree = FrameTree()
        self._parents: dict[str, str] = {}
        self._lock = threading.Lock()
        self._subscription = node.create_subscription(
            TFMessage, topics.TF_STATIC, self._add, latched(STATIC_DEPTH)
        )

    def lookup(self, target: str, origin: str) -> se3.Pose | None:
        """T_target_origin (4, 4) [m], or None as long as the frames are not connected."""
        with self._lock:
            return self._tree.lookup(target.lstrip("/"), origin.lstrip("/"))

    def root(self, frame: str) -> str:
        """The topmost frame above one; a frame must not get a second parent, its root may."""
        visited = {frame}
        while frame in self._parents and self._parents[frame] not in visited:
            frame = self._parents[frame]
            visited.add(frame)
        return frame

    def complaint(self) -> str:
        """Why transforms that are sent may not arrive, for people; empty where none is seen."""
        publishers = self._node.get_publishers_info_by_topic(topics.TF_STATIC)
        volatile = [p for p in publishers if p.qos_profile.durability == DurabilityPolicy.VOLATILE]
        if not volatile:
            return ""
        return (
            f" (/tf_static has {describe(volatile)} that sends it as volatile, so that nobody who "
            "wants it latched gets it; let that send it transient local)"
        )

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._subscription)

    def _add(self, message: TFMessage) -> None:
        with self._lock:
            self._tree.add(message)
            for transform in message.transforms:
                child = transform.child_frame_id.lstrip("/")
                if child in self._tree:
                    self._parents[child] = transform.header.frame_id.lstrip("/")


@dataclass(frozen=True)
class CameraMount:
    """Where the camera sits.

    Attributes:
        base_frame: name of the base.
        optical_frame: name of the images' frame.
        T_base_optical: (4, 4) [m].
    """

    base_frame: str
    optical_frame: str
    T_base_optical: se3.Pose

    @property
    def base_is_optical(self) -> bool:
        """Whether the optical frame stands in for a base."""
        return self.base_frame == self.optical_frame


class BaseFrame:
    """Finds where the images' optical frame sits on the robot's base.

    The base is the frame asked for as soon as /tf_static connects it. If that does not happen
    within the time-out, the optical frame itself is the base: tracking works, and the map's axes
    are those of the first camera (x forward, z up) all the same.

    Args:
        transforms: that have been received.
        wanted: base frame; empty for the optical frame.
        timeout_s: how long to wait from the first image [s].
        warn: takes messages for people.
    """

    def __init__(
        self,
        transforms: StaticTransforms,
        wanted: str,
        timeout_s: float,
        warn: Callable[[str], object],
    ) -> None:
        self._transforms = transforms
        self._wanted = wanted.lstrip("/")
        self._timeout_s = timeout_s
        self._warn = warn
        self._deadline: float | None = None
        self._mount: CameraMount | None = None

    def resolve(self, optical_frame: str) -> CameraMount | None:
        """The camera's mount; None as long as it is worth waiting for /tf_static.

        Raises:
            FrameError: when the images name no frame.
        """
        optical_frame = optical_frame.lstrip("/")
        if not optical_frame:
            raise FrameError("images carry no frame_id; set it in the camera's driver")
        if self._mount is not None and self._mount.optical_frame == optical_frame:
            return self._mount
        T_base_optical = self._transforms.lookup(self._wanted, optical_frame)
        if T_base_optical is not None:
            self._mount = CameraMount(self._wanted, optical_frame, T_base_optical)
        elif not self._wanted or self._waited_enough():
            if self._wanted:
                self._warn(
                    f"/tf_static does not connect {optical_frame!r} to the base frame "
                    f"{self._wanted!r}: the optical frame itself is the base now. Publish the "
                    f"transform, or set base_frame{self._transforms.complaint()}"
                )
            self._mount = CameraMount(optical_frame, optical_frame, np.eye(4))
        return self._mount

    def _waited_enough(self) -> bool:
        now = time.monotonic()
        if self._deadline is None:
            self._deadline = now + self._timeout_s
        return now >= self._deadline


class TransformBroadcaster:
    """Sends transforms on /tf."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(TFMessage, topics.TF, STREAM)

    def send(self, T_parent_child: se3.Pose, stamp_ns: int, parent: str, child: str) -> None:
        """Send where `child` lies in `parent` at a time; (4, 4) [m]."""
        transform = to_transform(T_parent_child, to_stamp(stamp_ns), parent, child)
        self._publisher.publish(TFMessage(transforms=[transform]))

    def close(self) -> None:
        """Stop publishing."""
        self._node.destroy_publisher(self._publisher)


class StaticBroadcaster:
    """Publishes one fixed transform on /tf_static, for as long as it lives."""

    def __init__(self, node: Node, T_parent_child: se3.Pose, parent: str, child: str) -> None:
        self._node = node
        self._publisher = node.create_publisher(TFMessage, topics.TF_STATIC, latched())
        transform = to_transform(T_parent_child, to_stamp(0), parent, child)
        self._publisher.publish(TFMessage(transforms=[transform]))

    def close(self) -> None:
        """Stop publishing."""
        self._node.destroy_publisher(self._publisher)
