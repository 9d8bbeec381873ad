from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from visualization_msgs.msg import Marker, MarkerArray

from meslam_core.map.stored_region import StoredRegion
from meslam_interfaces.msg import Region, RegionIndex, RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.qos import STREAM, latched
from meslam_ros.region_manager_node import RegionManagerNode
from meslam_ros.region_messages import region_model

WAIT_S = 10.0


@pytest.fixture(scope="module")
def regions() -> list[StoredRegion]:
    """Two neighbours."""
    scene, field = SphereInRoom(), learnt_field()
    centers = [GRID.center(index) for index in ((0, 0, 0), (1, 0, 0))]
    return [
        stored(field, scene, (number, 0, 0), (center[0], center[1], center[2]))
        for number, center in enumerate(centers)
    ]


def model(region: StoredRegion, map_id: str = "first") -> RegionModel:
    return region_model(region, map_id, "map", "int8")


class Tracking:
    """Publishes models and statuses as the tracking node does."""

    def __init__(self, client: MeslamClient) -> None:
        self._node = client.node
        self._status = self._node.create_publisher(TrackingStatus, topics.STATUS, STREAM)
        self._models: dict = {}

    def publish(self, message: RegionModel) -> None:
        key = tuple(message.index)
        if key not in self._models:
            self._models[key] = self._node.create_publisher(
                RegionModel, topics.REGION_MODELS, latched()
            )
        self._models[key].publish(message)

    def state(self, working: tuple, training: list[tuple] = (), map_id: str = "first") -> None:
        self._status.publish(
            TrackingStatus(
                map_id=map_id,
                working_region=np.array(working, np.int32),
                training_regions=[RegionIndex(index=np.array(i, np.int32)) for i in training],
            )
        )


def states(client: MeslamClient) -> list[int]:
    return [region.state for region in client.regions.regions] if client.regions else []


def test_regions_are_listed_with_their_states(start_node, client, regions) -> None:
    tracking = Tracking(client)
    for region in regions:
        tracking.publish(model(region))
    start_node(RegionManagerNode)
    # The manager came late: it still gets every region.
    assert client.spin_until(lambda: len(states(client)) == 2, WAIT_S)
    assert states(client) == [Region.AT_REST, Region.AT_REST]
    assert client.regions.working == -1
    tracking.state((0, 0, 0), [(1, 0, 0)])
    assert client.spin_until(lambda: states(client) == [Region.WORKING, Region.TRAINING], WAIT_S)
    tracking.state((1, 0, 0))
    assert client.spin_until(lambda: states(client) == [Region.AT_REST, Region.WORKING], WAIT_S)
    array = client.regions
    assert array.working == 1
    assert array.header.frame_id == "map"
    assert array.map_id == "first"
    assert array.overlap == pytest.approx(0.2)
    first = array.regions[0]
    assert first.size_m.x == pytest.approx(regions[0].side_m)
    assert first.bytes == len(model(regions[0]).data)
    assert first.observed_volume_m3 == pytest.approx(regions[0].mask.observed_volume_m3)
    assert array.regions[1].pose.position.x == pytest.approx(GRID.spacing_m)


def test_a_changed_period_counts_at_once(start_node, client, regions) -> None:
    node = start_node(RegionManagerNode, regions_period_s=60.0)
    tracking = Tracking(client)
    tracking.publish(model(replace(regions[0], version=1)))
    assert client.spin_until(lambda: bool(states(client)), WAIT_S)
    tracking.publish(model(replace(regions[0], version=2)))
    client.spin_until(lambda: False, 1.0)
    assert client.regions.regions[0].version == 1
    request = SetParameters.Request(
        parameters=[Parameter("regions_period_s", value=0.1).to_parameter_msg()]
    )
    answer = client.call(SetParameters, f"/{node.get_name()}/set_parameters", request)
    assert answer.results[0].successful
    assert client.spin_until(lambda: client.regions.regions[0].version == 2, WAIT_S)


def test_markers_show_boxes_labels_and_the_intersection(start_node, client, regions) -> None:
    seen: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, topics.REGION_MARKERS, seen.append, latched())
    start_node(RegionManagerNode)
    tracking = Tracking(client)
    for region in regions:
        tracking.publish(model(region))

    def kinds() -> list[str]:
        return [m.ns for m in seen[-1].markers if m.action == Marker.ADD] if seen else []

    assert client.spin_until(lambda: kinds().count("regions") == 2, WAIT_S)
    assert kinds().count("region_labels") == 2
    (shared,) = [m for m in seen[-1].markers if m.ns == "intersections"]
    assert shared.scale.x == pytest.approx(0.2 * regions[0].side_m)
    assert shared.pose.position.x == pytest.approx(0.5 * GRID.spacing_m)


def test_newest_version_counts_and_a_new_map_replaces_the_old(start_node, client, regions) -> None:
    start_node(RegionManagerNode, regions_period_s=0.05)
    tracking = Tracking(client)
    newer, older = replace(regions[0], version=7, keyframes=20), replace(regions[0], version=3)
    tracking.publish(model(newer))
    assert client.spin_until(lambda: bool(states(client)), WAIT_S)
    tracking.publish(model(older))
    tracking.publish(model(regions[1]))
    assert client.spin_until(lambda: len(states(client)) == 2, WAIT_S)
    assert client.regions.regions[0].version == 7
    assert client.regions.regions[0].keyframes == 20
    tracking.state((0, 0, 0), map_id="second")
    assert client.spin_until(lambda: client.regions.map_id == "second", WAIT_S)
    assert states(client) == []
    # What is still on its way from the old map is not mixed into the new one.
    tracking.publish(model(replace(regions[0], version=9)))
    tracking.publish(model(regions[1], "second"))
    assert client.spin_until(lambda: len(states(client)) == 1, WAIT_S)
    client.spin_until(lambda: False, 0.5)
    assert [list(region.index) for region in client.regions.regions] == [[1, 0, 0]]


@pytest.mark.parametrize("kind", ["bytes", "pose", "size"])
def test_unusable_models_are_refused_and_counted(start_node, client, regions, kind) -> None:
    """A number that is none must not end the node that draws the boxes."""
    start_node(RegionManagerNode)
    reports: list[DiagnosticStatus] = []
    client.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, lambda m: reports.extend(m.status), STREAM
    )
    tracking = Tracking(client)
    bad = model(replace(regions[1], version=regions[1].version + 1))
    if kind == "bytes":
        bad.data[100] ^= 1
    elif kind == "pose":
        bad.pose.position.x = float("nan")
    else:
        bad.size_m.x = -1.0
    tracking.publish(bad)
    tracking.publish(model(regions[0]))
    assert client.spin_until(
        lambda: any("region models refused: 1" in report.message for report in reports), WAIT_S
    )
    assert client.spin_until(
        lambda: client.regions is not None and len(client.regions.regions) == 1, WAIT_S
    )
