"""A camera in the textured room, sending one frame after the other to a tracking node."""

from __future__ import annotations

from dataclasses import replace

from data.ros_camera import CameraDriver
from data.textured_room import frame_at, path

from meslam_interfaces.msg import TrackingStatus
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS

POSES = path(12)
FAST = {
    "mapping__first_iterations": 150,
    "mapping__iterations": 8,
    "mapping__keyframe_iterations": 10,
    "mapping__final_iterations": 20,
    "keyframes__rays": 2048,
    "model_period_s": 0.1,
    "idle_s": 0.3,
    "transform_timeout_s": 1.0,
}
ANSWER_S = 30.0


class Camera:
    """Sends frames and waits until tracking has answered."""

    def __init__(self, client: MeslamClient, **options) -> None:
        self._client = client
        self._driver = CameraDriver(client.node, **options)

    def wait(self, nodes: int = 1) -> None:
        assert self._client.spin_until(lambda: self._driver.has_subscribers(nodes), ANSWER_S)

    def send(self, number: int, change=lambda messages: None, later_ns: int = 0) -> None:
        frame = frame_at(POSES[number], number)
        stamp_ns = frame.stamp_ns + NANOSECONDS + later_ns
        self._driver.send(replace(frame, stamp_ns=stamp_ns), change)

    def track(self, number: int, later_ns: int = 0) -> TrackingStatus:
        before = len(self._client.statuses)
        self.send(number, later_ns=later_ns)
        assert self._client.spin_until(lambda: len(self._client.statuses) > before, ANSWER_S)
        return self._client.statuses[-1]
