from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import ParameterType, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from meslam_core.config import MeslamConfig, settings
from meslam_core.errors import ConfigError
from meslam_ros import node_settings
from meslam_ros.managed_node import ManagedNode
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.parameters import FIXED, LIVE, declare_config, declare_settings, read_config
from meslam_ros.parameters import node_settings as entries_of
from meslam_ros.region_manager_node import RegionManagerNode
from meslam_ros.tracking_node import TrackingNode
from meslam_ros.viewer_settings import ViewerSettings

SECTIONS = list(MeslamConfig().to_mapping())
KINDS = [
    node_settings.FrameSettings,
    node_settings.InputSettings,
    node_settings.OdometrySettings,
    node_settings.TrackingSettings,
    node_settings.RegionManagerSettings,
    node_settings.MapServerSettings,
    node_settings.PlayerSettings,
    ViewerSettings,
]
TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
}


@pytest.fixture
def node_with() -> Iterator[Any]:
    nodes: list[Node] = []

    def make(**parameters: Any) -> Node:
        given = [Parameter(k.replace("__", "."), value=v) for k, v in parameters.items()]
        nodes.append(rclpy.create_node("parameters", parameter_overrides=given))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_are_those_of_the_configuration(node_with) -> None:
    assert declare_config(node_with(), SECTIONS) == MeslamConfig()


@pytest.mark.parametrize("kind", KINDS)
def test_defaults_of_the_nodes_own_settings_lie_in_their_ranges(kind: type, node_with) -> None:
    assert declare_settings(node_with(), kind) == kind()


def test_every_setting_is_described_with_type_unit_range_and_meaning(node_with) -> None:
    node = node_with()
    declare_config(node, SECTIONS)
    for entry in settings():
        described = node.describe_parameter(entry.path)
        assert described.type == TYPES[type(entry.default)]
        assert entry.meaning in described.description
        assert entry.unit in described.description
        assert (LIVE if entry.live else FIXED) in described.additional_constraints
        assert all(choice in described.additional_constraints for choice in entry.choices)
        ranges = [*described.floating_point_range, *described.integer_range]
        for bounds in ranges:
            assert (bounds.from_value, bounds.to_value) == (entry.minimum, entry.maximum)
        assert bool(ranges) == (entry.minimum is not None)


def test_given_values_reach_the_configuration(node_with) -> None:
    node = node_with(tracking__points=777, sensor__max_depth_m=4, odometry__method="colored_icp")
    config = declare_config(node, SECTIONS)
    assert config.tracking.points == 777
    assert config.sensor.max_depth_m == 4.0
    assert isinstance(config.sensor.max_depth_m, float)
    assert config.odometry.method == "colored_icp"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("tracking.points", 5, ("tracking.points", "100", "50000")),
        ("tracking.points", 1500.0, ("tracking.points", "float", "int")),
        ("sensor.max_depth_m", 1e9, ("sensor.max_depth_m", "30")),
        ("sensor.max_depth_m", "far", ("sensor.max_depth_m", "str")),
        ("odometry.method", "magic", ("odometry.method", "colored_icp")),
        ("sensor.max_depth_m", float("nan"), ("sensor.max_depth_m",)),
    ],
)
def test_unusable_values_are_refused_by_name(
    name: str, value: Any, words: tuple[str, ...], node_with
) -> None:
    node = node_with(**{name.replace(".", "__"): value})
    with pytest.raises(ConfigError) as error:
        declare_config(node, SECTIONS)
    assert all(word in str(error.value) for word in words)


def test_live_settings_follow_their_parameters(node_with) -> None:
    node = node_with()
    current = declare_settings(node, node_settings.TrackingSettings)
    results = node.set_parameters([Parameter("queue_size", value=3), Parameter("idle_s", value=2)])
    assert all(result.successful for result in results)
    assert (current.queue_size, current.idle_s) == (3, 2.0)
    assert LIVE in node.describe_parameter("queue_size").additional_constraints


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("queue_size", 0, ("queue_size",)),
        ("queue_size", "many", ("queue_size", "str", "int")),
        ("idle_s", float("nan"), ("idle_s",)),
        ("tracking.points", 2, ("tracking.points",)),
    ],
)
def test_changes_are_checked_like_values_given_at_start(name, value, words, node_with) -> None:
    node = node_with()
    current = declare_settings(node, node_settings.TrackingSettings)
    declare_config(node, SECTIONS)
    before = replace(current)
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    assert all(word in result.reason for word in words), result.reason
    assert current == before
    assert read_config(node) == MeslamConfig()


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (TrackingNode, "mapping.first_iterations", 7),
        (TrackingNode, "odom_frame", "wheels"),
        (OdometryNode, "sensor.max_depth_m", 3.0),
        (RegionManagerNode, "regions.overlap", 0.3),
        (MapServerNode, "map_folder", "elsewhere"),
    ],
)
def test_what_is_taken_at_configure_says_so_while_the_node_runs(
    kind: type[ManagedNode], name: str, value: Any, start_node, client
) -> None:
    """Through the services that `ros2 param` uses."""
    node = start_node(kind)

    def change() -> SetParametersResult:
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        service = f"/{node.get_name()}/set_parameters"
        return client.call(SetParameters, service, request).results[0]

    refused = change()
    assert not refused.successful
    assert all(word in refused.reason for word in (name, f"/{node.get_name()}", "cleanup"))
    node.trigger_deactivate()
    assert not change().successful
    node.trigger_cleanup()
    assert change().successful
    assert node.start()
    assert node.get_parameter(name).value == value


def test_configuration_is_read_anew_at_configure(start_node) -> None:
    node = start_node(OdometryNode)
    node.trigger_deactivate()
    node.trigger_cleanup()
    node.set_parameters([Parameter("odometry.method", value="none")])
    assert not node.start()
    node.set_parameters([Parameter("odometry.method", value="direct")])
    assert node.start()


def test_no_name_is_used_twice() -> None:
    names = [entry.path for entry in settings()]
    kinds = {kind.__name__: {entry.name for entry in entries_of(kind)} for kind in KINDS}
    assert len(names) == len(set(names))
    tracking = [
        *kinds["FrameSettings"],
        *kinds["InputSettings"],
        *kinds["TrackingSettings"],
        *SECTIONS,
    ]
    assert len(tracking) == len(set(tracking))
