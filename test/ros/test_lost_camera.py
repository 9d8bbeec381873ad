"""What the tracking node publishes while the camera is covered, and when it sees again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from data.room_camera import ANSWER_S, FAST, POSES
from data.ros_camera import CameraDriver
from data.textured_room import PERIOD_NS, frame_at

from meslam_core.evaluation.relocalisation import dark
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_interfaces.msg import TrackingStatus
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.tracking_node import TrackingNode

LOST_AFTER = 2
TURNED = exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(170.0), 0.0]))


class Camera:
    """Sends one frame after the other and waits until tracking has answered."""

    def __init__(self, client: MeslamClient) -> None:
        self._client = client
        self._driver = CameraDriver(client.node)
        self._stamp_ns = NANOSECONDS
        assert client.spin_until(lambda: self._driver.has_subscribers(2), ANSWER_S)

    def track(self, frame: RgbdFrame) -> TrackingStatus:
        before = len(self._client.statuses)
        self._stamp_ns += PERIOD_NS
        self._driver.send(replace(frame, stamp_ns=self._stamp_ns))
        assert self._client.spin_until(lambda: len(self._client.statuses) > before, ANSWER_S)
        return self._client.statuses[-1]


def test_a_covered_camera_publishes_no_pose_until_it_is_found_again(start_node, client) -> None:
    start_node(OdometryNode)
    start_node(TrackingNode, tracking__lost_after_frames=LOST_AFTER, **FAST)
    camera = Camera(client)
    for number in range(6):
        assert camera.track(frame_at(POSES[number])).state == TrackingStatus.OK
    covered = [camera.track(dark(frame_at(POSES[5]))) for _ in range(LOST_AFTER + 2)]
    assert covered[0].state == TrackingStatus.DEGRADED
    assert [status.state for status in covered[-3:]] == [TrackingStatus.LOST] * 3
    assert all(status.reason for status in covered)
    published = len(client.poses)

    states = [camera.track(frame_at(POSES[5])).state for _ in range(2)]
    assert states == [TrackingStatus.RELOCALISING, TrackingStatus.OK]
    assert client.spin_until(lambda: len(client.poses) == published + 1, ANSWER_S)
    T_map_base = client.poses[max(client.poses)]
    assert np.linalg.norm((inverse(POSES[5] @ inverse(T_BODY_OPTICAL)) @ T_map_base)[:3, 3]) < 0.03


def test_a_camera_lost_for_too_long_begins_a_new_map_where_that_is_wanted(
    start_node, client, capfd
) -> None:
    start_node(OdometryNode)
    options = {"relocalisation__new_map_after_s": 0.2, "tracking__lost_after_frames": LOST_AFTER}
    start_node(TrackingNode, **options, **FAST)
    camera = Camera(client)
    first = [camera.track(frame_at(POSES[number])) for number in range(4)][-1]
    away = frame_at(POSES[0] @ TURNED)
    states, status = [], first
    while status.map_id == first.map_id and len(states) < 20:
        status = camera.track(away)
        states.append(status.state)
    assert TrackingStatus.LOST in states
    assert states[-1] == TrackingStatus.OK
    assert status.map_id != first.map_id
    assert "lost for too long; a new map begins" in capfd.readouterr().err
