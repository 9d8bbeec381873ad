"""Moving frames: where any frame of /tf and /tf_static was at a time."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left, insort
from collections.abc import Iterator

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from tf2_msgs.msg import TFMessage

from meslam_core import se3
from meslam_core.errors import FrameError
from meslam_core.recordings.transforms import MAX_FRAMES
from meslam_ros import topics
from meslam_ros.conversions import NANOSECONDS, from_transform, stamp_ns
from meslam_ros.qos import latched
from meslam_ros.transforms import STATIC_DEPTH

HISTORY = 2000
TF_DEPTH = 100
MAX_EXTRAPOLATION_NS = NANOSECONDS // 2
LATEST = 0
PATIENCE_S = 1.0


class _Edge:
    """One frame in its parent over time; a static one has a single pose."""

    def __init__(self, parent: str, static: bool) -> None:
        self.parent = parent
        self.static = static
        self.stamps: list[int] = []
        self.poses: dict[int, se3.Pose] = {}

    def add(self, stamp: int, pose: se3.Pose) -> None:
        """Keep a pose; the oldest are forgotten, and all when time jumps back."""
        if self.stamps and stamp < self.stamps[-1] - NANOSECONDS:
            self.stamps.clear()
            self.poses.clear()
        if stamp not in self.poses:
            insort(self.stamps, stamp)
        self.poses[stamp] = pose
        if len(self.stamps) > (1 if self.static else HISTORY):
            del self.poses[self.stamps.pop(0)]

    def at(self, stamp: int) -> se3.Pose | None:
        """T_parent_child (4, 4) at a stamp, the latest for `LATEST`; None where unknown."""
        if self.static or stamp == LATEST:
            return self.poses[self.stamps[-1]]
        place = bisect_left(self.stamps, stamp)
        if place < len(self.stamps) and self.stamps[place] == stamp:
            return self.poses[stamp]
        if place == len(self.stamps):
            recent = stamp - self.stamps[-1] <= MAX_EXTRAPOLATION_NS
            return self.poses[self.stamps[-1]] if recent else None
        if place == 0:
            return None
        before, after = self.stamps[place - 1], self.stamps[place]
        fraction = (stamp - before) / (after - before)
        return se3.interpolate(self.poses[before], self.poses[after], fraction)


class TransformBuffer:
    """Collects /tf_static, and /tf from the first question about a moving frame on.

    /tf carries many messages a second, which would keep a node busy that is never asked.
    May be asked from any thread but the executor's only one.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()
        self._static = node.create_subscription(
            TFMessage, topics.TF_STATIC, lambda m: self._add(m, True), latched(STATIC_DEPTH)
        )
        self._moving: Subscription | None = None

    def lookup(self, target: str, origin: str, stamp: int = LATEST) -> se3.Pose:
        """T_target_origin (4, 4) [m] at a stamp [ns].

        Args:
            target, origin: names of frames.
            stamp: time; `LATEST` takes the newest of every frame on the way.

        Raises:
            FrameError: when the frames are not known, not connected, or not at that time.
        """
        deadline = time.monotonic() + PATIENCE_S
        with self._changed:
            while True:
                try:
                    return self._connected(target.lstrip("/"), origin.lstrip("/"), stamp)
                except FrameError:
                    self._listen()
                    left_s = deadline - time.monotonic()
                    if left_s <= 0:
                        raise
                    self._changed.wait(left_s)

    def _listen(self) -> None:
        """Begin to collect /tf."""
        if self._moving is None:
            self._moving = self._node.create_subscription(
                TFMessage, topics.TF, lambda m: self._add(m, False), QoSProfile(depth=TF_DEPTH)
            )

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._static)
        if self._moving is not None:
            self._node.destroy_subscription(self._moving)

    def _connected(self, target: str, origin: str, stamp: int) -> se3.Pose:
        target_chain = dict(self._chain(target, stamp))
        for frame, T_frame_origin in self._chain(origin, stamp):
            if frame in target_chain:
                return se3.inverse(target_chain[frame]) @ T_frame_origin
        parents = {edge.parent for edge in self._edges.values()}
        known = ", ".join(sorted(parents | set(self._edges))) or "nothing"
        raise FrameError(
            f"TF does not connect {origin!r} to {target!r}; it knows {known}. Publish the "
            "transform that is missing"
        )

    def _chain(self, frame: str, stamp: int) -> Iterator[tuple[str, se3.Pose]]:
        """A frame and everything above it, with T_above_frame; ends where a time is unknown.

        Raises:
            FrameError: when a frame on the way is known, but not at that time.
        """
        T_above_frame, visited = np.eye(4), {frame}
        start = frame
        yield frame, T_above_frame
        while frame in self._edges and self._edges[frame].parent not in visited:
            edge = self._edges[frame]
            pose = edge.at(stamp)
            if pose is None:
                raise FrameError(
                    f"where {frame!r} was at {stamp / NANOSECONDS:.3f} s is not known (asked for "
                    f"{start!r}); known are {edge.stamps[0] / NANOSECONDS:.3f} to "
                    f"{edge.stamps[-1] / NANOSECONDS:.3f} s"
                )
            frame, T_above_frame = edge.parent, pose @ T_above_frame
            visited.add(frame)
            yield frame, T_above_frame

    def _add(self, message: TFMessage, static: bool) -> None:
        with self._changed:
            for transform in message.transforms:
                child = transform.child_frame_id.lstrip("/")
                parent = transform.header.frame_id.lstrip("/")
                try:
                    pose = from_transform(transform.transform)
                except FrameError:
                    continue
                edge = self._edges.get(child)
                if edge is None and len(self._edges) >= MAX_FRAMES:
                    continue
                if edge is None or edge.parent != parent or edge.static != static:
                    edge = self._edges[child] = _Edge(parent, static)
                edge.add(stamp_ns(transform.header.stamp), pose)
            self._changed.notify_all()
