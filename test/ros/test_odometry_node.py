from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.ros_camera import CameraDriver
from data.textured_room import frame_at, path
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage

from meslam_core.camera import PinholeCamera
from meslam_core.se3 import exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, from_pose, stamp_ns
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import STREAM
from meslam_ros.stamp_guard import FOLLOWERS_BACK
from meslam_ros.transforms import StaticBroadcaster

CAMERA = PinholeCamera(width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
COUNT = 6
POSES = path(COUNT)
FRAMES = [frame_at(pose, number, CAMERA) for number, pose in enumerate(POSES)]
WAIT_S = 20.0


class Listener:
    def __init__(self, client: MeslamClient) -> None:
        self.odometry: list[Odometry] = []
        self.transforms: list[TFMessage] = []
        client.node.create_subscription(Odometry, topics.ODOMETRY, self.odometry.append, STREAM)
        client.node.create_subscription(TFMessage, topics.TF, self.transforms.append, STREAM)


def test_motion_twist_and_transform_follow_the_camera(start_node, client) -> None:
    start_node(OdometryNode, odometry_queue_size=30)
    listener, driver = Listener(client), CameraDriver(client.node)
    assert client.spin_until(driver.has_subscribers, WAIT_S)
    stamps = [driver.send(frame) for frame in FRAMES]
    assert client.spin_until(lambda: len(listener.odometry) == COUNT, WAIT_S)
    assert [stamp_ns(m.header.stamp) for m in listener.odometry] == stamps
    for pose, message in zip(POSES, listener.odometry, strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "camera_link")
        truth = pose @ inverse(T_BODY_OPTICAL)
        offset = inverse(truth) @ from_pose(message.pose.pose)
        assert np.linalg.norm(offset[:3, 3]) < 0.01
        assert 0 <= message.twist.covariance[0] < 1.0
    speed = listener.odometry[-1].twist.twist.linear
    assert np.linalg.norm([speed.x, speed.y, speed.z]) == pytest.approx(0.15, rel=0.3)
    assert client.spin_until(lambda: len(listener.transforms) == COUNT, WAIT_S)
    last = listener.transforms[-1].transforms[0]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "camera_link")
    position = listener.odometry[-1].pose.pose.position
    assert last.transform.translation.x == pytest.approx(position.x)


def test_frame_with_a_parent_gets_no_second_one(start_node, client) -> None:
    """On a robot whose description mounts camera_link, its root moves in odom instead."""
    start_node(OdometryNode, odometry_queue_size=30)
    listener, driver = Listener(client), CameraDriver(client.node)
    T_base_link = exp(np.array([0.1, 0.0, 0.5, 0.0, 0.0, 0.3]))
    kept = StaticBroadcaster(client.node, T_base_link, "base_link", "camera_link")
    assert client.spin_until(driver.has_subscribers, WAIT_S), kept
    client.spin_until(lambda: False, 0.5)
    for frame in FRAMES[:3]:
        driver.send(frame)
    assert client.spin_until(lambda: len(listener.transforms) == 3, WAIT_S)
    for message, transform in zip(listener.odometry, listener.transforms, strict=True):
        (edge,) = transform.transforms
        assert (edge.header.frame_id, edge.child_frame_id) == ("odom", "base_link")
        expected = from_pose(message.pose.pose) @ inverse(T_base_link)
        assert edge.transform.translation.z == pytest.approx(expected[2, 3], abs=1e-9)


def test_odometry_begins_anew_when_the_recording_does(start_node, client, capfd) -> None:
    start_node(OdometryNode, odometry_queue_size=30)
    listener, driver = Listener(client), CameraDriver(client.node)
    assert client.spin_until(driver.has_subscribers, WAIT_S)
    for number, frame in enumerate(FRAMES[:3]):
        driver.send(replace(frame, stamp_ns=frame.stamp_ns + 100 * NANOSECONDS))
        assert client.spin_until(lambda n=number: len(listener.odometry) > n, WAIT_S)
    # The first ones of the second round only tell that it is one.
    for number in range(FOLLOWERS_BACK + 1):
        driver.send(replace(FRAMES[0], stamp_ns=FRAMES[0].stamp_ns + number * NANOSECONDS // 15))
        client.spin_until(lambda: len(listener.odometry) > 3, 0.2)
    assert client.spin_until(lambda: len(listener.odometry) == 4, WAIT_S)
    np.testing.assert_allclose(from_pose(listener.odometry[-1].pose.pose), np.eye(4), atol=1e-9)
    assert "started again" in capfd.readouterr().err
