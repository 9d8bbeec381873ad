"""Nodes with use_sim_time: the clock may stand still, jump, or be missing."""

from __future__ import annotations

from dataclasses import replace

from builtin_interfaces.msg import Time
from data.ros_camera import CameraDriver
from data.textured_room import frame_at, path
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock

from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import STREAM
from meslam_ros.tracking_node import TrackingNode

ANSWER_S = 30.0
POSES = path(6)
QUICK = {
    "mapping__first_iterations": 150,
    "mapping__iterations": 8,
    "mapping__final_iterations": 20,
    "keyframes__rays": 2048,
    "idle_s": 0.3,
}


def test_a_clock_that_stands_jumps_or_is_missing_stops_nothing(start_node, client, capfd) -> None:
    start_node(OdometryNode, use_sim_time=True, input_timeout_s=0.5)
    start_node(TrackingNode, use_sim_time=True, **QUICK)
    reports: list[DiagnosticArray] = []
    client.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, reports.append, STREAM)
    clock = client.node.create_publisher(Clock, topics.CLOCK, STREAM)
    # Nothing has published a time yet, and the nodes say all the same what they wait for.
    assert client.spin_until(lambda: len(reports) >= 2, ANSWER_S)
    assert "no image pair" in capfd.readouterr().err
    camera = CameraDriver(client.node)
    assert client.spin_until(lambda: camera.has_subscribers(2), ANSWER_S)
    map_ids = []
    # Forwards, standing still, and back by a second that is not one of the images'.
    for number, seconds in enumerate((1000, 1001, 1001, 1000, 1002)):
        clock.publish(Clock(clock=Time(sec=seconds)))
        frame = frame_at(POSES[number], number)
        before = len(client.statuses)
        stamp_ns = frame.stamp_ns + 1000 * NANOSECONDS
        camera.send(replace(frame, stamp_ns=stamp_ns))
        assert client.spin_until(lambda n=before: len(client.statuses) > n, ANSWER_S)
        assert client.statuses[-1].state == TrackingStatus.OK
        map_ids.append(client.statuses[-1].map_id)
    assert len(set(map_ids)) == 1
    assert client.spin_until(lambda: client.settled, ANSWER_S)
    assert client.spin_until(lambda: reports[-1].header.stamp.sec == 1002, ANSWER_S)
