"""/meslam/path: all frames as they are known now, at a bounded rate."""

from __future__ import annotations

import time
from collections.abc import Callable

from nav_msgs.msg import Path
from rclpy.node import Node

from meslam_ros import topics
from meslam_ros.mapping_session import MappingSession
from meslam_ros.qos import latched
from meslam_ros.tracking_messages import path_message

# Building a path takes a time that grows with its length; it may take this share of all time.
PATH_SHARE = 0.03


class PathPublisher:
    """Publishes the refined path, less often when it grows long.

    Args:
        node: that publishes.
        map_frame: of the poses.
        period_s: tells in what time it is published at most once [s].
    """

    def __init__(self, node: Node, map_frame: str, period_s: Callable[[], float]) -> None:
        self._node = node
        self._map_frame = map_frame
        self._period_s = period_s
        self._due_s = 0.0
        self._publisher = node.create_publisher(Path, topics.PATH, latched())

    def begin(self) -> None:
        """Another map begins; its path may be published at once."""
        self._due_s = 0.0

    def offer(self, session: MappingSession) -> None:
        """Publish if it is due and somebody listens."""
        if time.monotonic() >= self._due_s and self._publisher.get_subscription_count():
            self.publish(session)

    def publish(self, session: MappingSession) -> None:
        """Publish now, for those who come later too."""
        started = time.monotonic()
        path = path_message(session.trajectory(), session.T_camera_base, self._map_frame)
        self._publisher.publish(path)
        ended = time.monotonic()
        self._due_s = ended + max(self._period_s(), (ended - started) / PATH_SHARE)

    def close(self) -> None:
        """Stop publishing."""
        self._node.destroy_publisher(self._publisher)
