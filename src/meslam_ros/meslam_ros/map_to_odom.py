"""The transform from map to odometry, corrected with every frame and sent in between (REP-105)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
from rclpy.node import Node

from meslam_core import se3
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.transforms import TransformBroadcaster

MAX_AHEAD_S = 0.5


class MapToOdom:
    """Keeps and broadcasts T_map_odom.

    A thread of its own repeats it: with a timer, the executor would look at all that the node
    listens to each time. Stamps continue those of the images, so that they fit the odometry's
    whatever clock the camera or recording has.

    Args:
        node: that broadcasts.
        map_frame, odom_frame: parent and child; an update may change the child.
        rate_hz: tells how often it is repeated [Hz].
    """

    def __init__(
        self, node: Node, map_frame: str, odom_frame: str, rate_hz: Callable[[], float]
    ) -> None:
        self._map_frame = map_frame
        self._odom_frame = odom_frame
        self._rate_hz = rate_hz
        self._broadcaster = TransformBroadcaster(node)
        self._lock = threading.Lock()
        self.reset()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map to odom", daemon=True)
        self._thread.start()

    def reset(self) -> None:
        """Forget the correction; nothing is sent until the next one."""
        with self._lock:
            self._T_map_odom = np.eye(4)
            self._stamp_ns: int | None = None
            self._updated_s = 0.0

    def update(self, stamp_ns: int, T_map_odom: se3.Pose | None, odom_frame: str) -> None:
        """Take and send the correction as of an image; None keeps the one before."""
        with self._lock:
            self._odom_frame = odom_frame
            if T_map_odom is not None:
                self._T_map_odom = T_map_odom
            self._stamp_ns, self._updated_s = stamp_ns, time.monotonic()
            self._send(stamp_ns)

    def _run(self) -> None:
        while not self._closing.wait(1.0 / self._rate_hz()):
            self._repeat()

    def _repeat(self) -> None:
        with self._lock:
            elapsed_s = time.monotonic() - self._updated_s
            if self._stamp_ns is not None and elapsed_s >= 0.5 / self._rate_hz():
                ahead_s = min(elapsed_s, MAX_AHEAD_S)
                self._send(self._stamp_ns + round(ahead_s * NANOSECONDS))

    def _send(self, stamp_ns: int) -> None:
        self._broadcaster.send(self._T_map_odom, stamp_ns, self._map_frame, self._odom_frame)

    def close(self) -> None:
        """Stop sending."""
        self._closing.set()
        self._thread.join()
        self._broadcaster.close()
