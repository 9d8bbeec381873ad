"""Two systems on one computer, apart by namespace or by domain, and neither knows of the other."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from data import ros_domain
from data.analytic_scene import SphereInRoom, learnt_field, stored
from data.ros_camera import CameraDriver, Messages
from data.textured_room import frame_at, path
from tf2_msgs.msg import TFMessage

from meslam_core.se3 import inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.processes import NodeProcess
from meslam_ros.qos import STREAM, latched
from meslam_ros.region_manager_node import RegionManagerNode
from meslam_ros.region_messages import region_model
from meslam_ros.tracking_node import TrackingNode
from meslam_ros.transforms import StaticBroadcaster

ANSWER_S = 30.0
STARTING_S = 60.0
FRAMES = 4
QUICK = {
    "mapping__first_iterations": 150,
    "mapping__iterations": 8,
    "mapping__final_iterations": 20,
    "keyframes__rays": 2048,
    "model_period_s": 0.1,
}


class Robot:
    """A namespace with nodes, frames and a camera of its own."""

    def __init__(self, name: str, start_node, client: MeslamClient, poses) -> None:
        self.client = client
        self._poses = poses
        frames = {f"{frame}_frame": f"{name}/{frame}" for frame in ("map", "odom", "base")}
        for kind in (OdometryNode, TrackingNode):
            given = QUICK if kind is TrackingNode else {}
            start_node(kind, namespace=name, **frames, **given)
        start_node(RegionManagerNode, namespace=name, map_frame=f"{name}/map")
        self._optical = f"{name}/optical"
        self._camera = CameraDriver(client.node, mounted=False)
        self._kept = StaticBroadcaster(client.node, T_BODY_OPTICAL, f"{name}/base", self._optical)

    def track(self, number: int) -> TrackingStatus:
        assert self.client.spin_until(lambda: self._camera.has_subscribers(2), ANSWER_S)
        frame = frame_at(self._poses[number], number)
        before = len(self.client.statuses)
        self._camera.send(replace(frame, stamp_ns=frame.stamp_ns + NANOSECONDS), self._rename)
        assert self.client.spin_until(lambda: len(self.client.statuses) > before, ANSWER_S)
        return self.client.statuses[-1]

    def errors(self) -> list[float]:
        truth = [inverse(self._poses[0]) @ pose for pose in self._poses[:FRAMES]]
        found = [T @ T_BODY_OPTICAL for _, T in sorted(self.client.poses.items())]
        moved = [inverse(found[0]) @ pose for pose in found]
        return [
            float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(moved, truth, strict=True)
        ]

    def _rename(self, messages: Messages) -> None:
        for message in messages:
            message.header.frame_id = self._optical


@pytest.fixture
def clients() -> Iterator[list[MeslamClient]]:
    with MeslamClient("left", "left") as left, MeslamClient("right", "right") as right:
        yield [left, right]


def test_two_robots_in_their_namespaces(start_node, clients) -> None:
    transforms: list[TFMessage] = []
    clients[0].node.create_subscription(TFMessage, topics.TF, transforms.append, STREAM)
    robots = [
        Robot(client.node.get_namespace().strip("/"), start_node, client, poses)
        for client, poses in zip(
            clients, (path(FRAMES), path(FRAMES, step_m=0.02, step_deg=-0.5)), strict=True
        )
    ]
    statuses = [[robot.track(number) for robot in robots] for number in range(FRAMES)]
    assert all(status.state == TrackingStatus.OK for pair in statuses for status in pair)
    assert all(status.frames_received == FRAMES for status in statuses[-1])
    maps = [{pair[place].map_id for pair in statuses} for place in range(2)]
    assert len(maps[0] | maps[1]) == 2
    for robot in robots:
        assert robot.client.spin_until(lambda r=robot: len(r.client.poses) == FRAMES, ANSWER_S)
        assert max(robot.errors()) < 0.01
        assert robot.client.spin_until(
            lambda r=robot: bool(r.client.regions and r.client.regions.regions), ANSWER_S
        )
        assert robot.client.regions.map_id == robot.client.statuses[-1].map_id

    def edges() -> set[tuple[str, str]]:
        found = [t for message in transforms for t in message.transforms]
        return {(t.header.frame_id, t.child_frame_id) for t in found}

    expected = {
        edge
        for robot in ("left", "right")
        for edge in ((f"{robot}/map", f"{robot}/odom"), (f"{robot}/odom", f"{robot}/base"))
    }
    assert clients[0].spin_until(lambda: edges() >= expected, ANSWER_S)
    assert edges() == expected


def test_two_processes_in_two_domains(start_node, tmp_path) -> None:
    """The same names everywhere: only the domain keeps them apart."""
    other = ros_domain.OTHER_DOMAIN
    region = stored(learnt_field(), SphereInRoom())
    start_node(RegionManagerNode)
    process = NodeProcess(
        "region_manager_node",
        environment={**os.environ, "ROS_DOMAIN_ID": str(other)},
        log=tmp_path / "other.log",
    )
    try:
        with MeslamClient("here") as here, MeslamClient("there", domain_id=other) as there:
            for client, map_id in ((here, "here"), (there, "there")):
                publisher = client.node.create_publisher(
                    RegionModel, topics.REGION_MODELS, latched()
                )
                publisher.publish(region_model(region, map_id, "map", "int8"))
            for client in (here, there):
                assert client.spin_until(
                    lambda c=client: bool(c.regions and c.regions.regions), STARTING_S
                ), process.output()
                client.spin_until(lambda: False, 0.5)
            assert (here.regions.map_id, there.regions.map_id) == ("here", "there")
            assert "there" not in here.node.get_node_names()
            assert there.node.get_node_names().count("region_manager_node") == 1
    finally:
        process.stop()
