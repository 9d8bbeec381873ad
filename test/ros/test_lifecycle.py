"""Nodes taken through their lifecycle again and again."""

from __future__ import annotations

import os
import threading
from dataclasses import replace

import pytest
from data.ros_camera import CameraDriver
from data.textured_room import frame_at, path
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn

from meslam_interfaces.msg import RegionModel
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.managed_node import ManagedNode
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import latched
from meslam_ros.region_manager_node import RegionManagerNode
from meslam_ros.tracking_node import TrackingNode

KINDS = [OdometryNode, TrackingNode, RegionManagerNode, MapServerNode]
SUCCESS = TransitionCallbackReturn.SUCCESS
CYCLES = 8
ANSWER_S = 30.0
POSES = path(8)
QUICK = {
    "mapping__first_iterations": 100,
    "mapping__iterations": 8,
    "mapping__final_iterations": 20,
    "keyframes__rays": 2048,
    "model_period_s": 0.1,
    "idle_s": 0.3,
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch) -> None:
    """What the nodes write by default lands here."""
    monkeypatch.chdir(tmp_path)


def held(node: ManagedNode) -> dict[str, int]:
    """What a node could leave behind."""
    kinds = ("publishers", "subscriptions", "services", "clients", "timers", "guards")
    counts = {kind: len(list(getattr(node, kind))) for kind in kinds}
    counts["threads"] = threading.active_count()
    counts["files"] = len(os.listdir("/proc/self/fd"))
    return counts


def cycle(node: ManagedNode) -> None:
    assert node.trigger_deactivate() == SUCCESS
    assert node.trigger_activate() == SUCCESS
    assert node.trigger_deactivate() == SUCCESS
    assert node.trigger_cleanup() == SUCCESS
    assert node.start()


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_left_behind(start_node, kind: type[ManagedNode]) -> None:
    node = start_node(kind)
    cycle(node)
    before = held(node)
    for _ in range(CYCLES):
        cycle(node)
    assert held(node) == before


@pytest.mark.parametrize("kind", KINDS)
def test_an_unconfigured_node_holds_no_topic_of_its_own(start_node, client, kind) -> None:
    node = start_node(kind)
    node.trigger_deactivate()
    node.trigger_cleanup()
    names = {publisher.topic_name for publisher in node.publishers}
    assert not any("meslam" in name or name in ("/tf", "/diagnostics") for name in names), names
    assert not any("meslam/" in service.srv_name for service in node.services)


@pytest.mark.parametrize("kind", KINDS)
def test_a_lifecycle_manager_starts_a_node_that_waits_for_it(start_node, client, kind) -> None:
    """As nav2's does: by the services, in its own time."""
    node = start_node(kind)
    node.trigger_deactivate()
    node.trigger_cleanup()
    name = f"/{node.get_name()}"

    def state() -> int:
        return int(client.call(GetState, f"{name}/get_state").current_state.id)

    assert state() == State.PRIMARY_STATE_UNCONFIGURED
    for transition, reached in (
        (Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE),
        (Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE),
        (Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE),
        (Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED),
    ):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert client.call(ChangeState, f"{name}/change_state", request).success
        assert state() == reached


class Camera:
    """Sends views and waits for the answers."""

    def __init__(self, client: MeslamClient) -> None:
        self._client = client
        self._driver = CameraDriver(client.node)
        self._number = 0

    def send(self) -> None:
        self._number += 1
        frame = frame_at(POSES[self._number], self._number)
        self._driver.send(replace(frame, stamp_ns=frame.stamp_ns + NANOSECONDS))

    def track(self) -> str:
        """The map's identity."""
        assert self._client.spin_until(self._driver.has_subscribers, ANSWER_S)
        before = len(self._client.statuses)
        self.send()
        assert self._client.spin_until(lambda: len(self._client.statuses) > before, ANSWER_S)
        return str(self._client.statuses[-1].map_id)

    def unheard(self) -> bool:
        return not self._driver.has_subscribers()


@pytest.fixture
def models(client: MeslamClient) -> list[RegionModel]:
    received: list[RegionModel] = []
    client.node.create_subscription(
        RegionModel, topics.REGION_MODELS, received.append, latched(100)
    )
    return received


def test_an_inactive_tracking_node_keeps_its_map_and_hears_nothing(
    start_node, client, models
) -> None:
    node = start_node(TrackingNode, **QUICK)
    camera = Camera(client)
    first = camera.track()
    node.trigger_deactivate()
    assert client.spin_until(camera.unheard, ANSWER_S)
    tracked = len(client.statuses)
    camera.send()
    node.trigger_activate()
    assert camera.track() == first
    assert len(client.statuses) == tracked + 1
    assert client.statuses[-1].frames_tracked == 2
    assert client.spin_until(lambda: bool(models), ANSWER_S)
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert node.start()
    assert camera.track() != first
    # Nobody gets the map that was given up.
    late: list[RegionModel] = []
    client.node.create_subscription(RegionModel, topics.REGION_MODELS, late.append, latched(100))
    assert client.spin_until(lambda: bool(late), ANSWER_S)
    client.spin_until(lambda: False, 0.5)
    assert {model.map_id for model in late} == {client.statuses[-1].map_id}
