from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from data.memory_recording import MemoryRecording
from data.synthetic_frames import plane_frames
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from meslam_core.recordings import convert
from meslam_ros import topics
from meslam_ros.bag_player_node import BagPlayerNode
from meslam_ros.camera_node import CameraNode
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.region_manager_node import RegionManagerNode
from meslam_ros.tracking_node import TrackingNode

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = (ROOT / "docs" / "interfaces.md").read_text()
NAMES = {name: value for name, value in vars(topics).items() if name.isupper()}
# What every node of ROS has.
COMMON_TOPICS = {"/rosout", "/parameter_events"}
COMMON_SERVICES = ("rcl_interfaces/", "lifecycle_msgs/", "type_description_interfaces/")
# Of the action export_map; the document names it as a whole.
ACTION = "/_action/"


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_topic_and_service_is_documented(name: str) -> None:
    assert f"`{NAMES[name].replace('~', 'bag_player_node')}`" in DOCUMENT


def test_parameters_of_the_nodes_are_documented_as_they_are() -> None:
    check = [sys.executable, str(ROOT / "tools" / "node_parameters.py"), "--check"]
    result = subprocess.run(check, check=False)
    assert result.returncode == 0, "run: python tools/node_parameters.py"


def documented() -> dict[str, tuple[str, str]]:
    """Type and the rest of the row of every topic and service, by absolute name."""
    rows = re.findall(r"^\| `([\w/]+)`[^|\n]* \| `([\w/]+)` \|([^\n]*)\|$", DOCUMENT, re.MULTILINE)
    return {"/" + name.lstrip("/"): (kind, rest) for name, kind, rest in rows}


@pytest.fixture
def nodes(start_node, tmp_path: Path) -> list:
    """All nodes, active."""
    path = tmp_path / "plane.mcap"
    convert(MemoryRecording(plane_frames(2)), path)
    folders = {"export_folder": str(tmp_path), "map_folder": str(tmp_path)}
    return [
        start_node(OdometryNode),
        start_node(TrackingNode),
        start_node(RegionManagerNode),
        start_node(MapServerNode, **folders),
        start_node(BagPlayerNode, recording=str(path), subscribers=100),
        start_node(lambda **options: CameraNode(list, **options)),
    ]


def test_everything_that_is_there_is_documented_as_it_is(nodes, client) -> None:
    known = documented()
    for node in nodes:
        name = node.get_name()
        published = node.get_publisher_names_and_types_by_node(name, "/")
        for topic, kinds in published:
            if topic in COMMON_TOPICS or ACTION in topic or topic.endswith("transition_event"):
                continue
            if topic.startswith("/tf") or topic == "/clock":
                assert f"`{topic}`" in DOCUMENT
                continue
            kind, rest = known[topic]
            assert kinds == [kind.replace("/", "/msg/")], topic
            for offer in node.get_publishers_info_by_topic(topic):
                profile = offer.qos_profile
                assert profile.reliability == ReliabilityPolicy.RELIABLE, topic
                latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
                assert latched == ("latched" in rest), topic
        for service, kinds in node.get_service_names_and_types_by_node(name, "/"):
            if kinds[0].startswith(COMMON_SERVICES) or ACTION in service:
                continue
            assert kinds[0].rpartition("/")[2] == known[service][0].rpartition("/")[2], service
