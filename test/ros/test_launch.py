"""What the launch file starts: planned without `launch`, started for real, and through `launch`."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from data.memory_recording import MemoryRecording
from data.synthetic_frames import plane_frames
from sensor_msgs.msg import CameraInfo

from meslam_core.recordings import convert
from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import ListRegions
from meslam_ros.conversions import stamp_ns
from meslam_ros.launch_plan import ARGUMENTS, SYSTEM, NodePlan, plan
from meslam_ros.processes import NodeProcess
from meslam_ros.qos import STREAM

SHARE = Path(get_package_share_directory("meslam_ros"))
LAUNCH_FILE = SHARE / "launch" / "meslam.launch.py"
WAIT_S = 90.0


def planned(**given: str) -> dict[str, NodePlan]:
    return {entry.name: entry for entry in plan(given, SHARE)}


def test_without_arguments_the_system_starts_for_a_camera_that_runs_already() -> None:
    nodes = planned()
    assert set(nodes) == set(SYSTEM)
    for node in nodes.values():
        assert node.package == "meslam_ros"
        assert node.parameters["base_frame"] == "camera_link"
        assert node.remappings == ()
        assert Path(node.params_file).is_file()
        assert node.essential


@pytest.mark.parametrize(
    "given",
    [
        {"recording": "room.mcap"},
        {"camera": "meslam", "rviz": "true"},
        {"camera": "realsense2"},
        {"viewer": "true"},
        {"odometry_topic": "/wheels/odom", "recording": "room.mcap"},
    ],
)
def test_all_executables_of_this_package_are_installed(given) -> None:
    for node in plan(given, SHARE):
        if node.package == "meslam_ros":
            executable = Path(get_package_prefix("meslam_ros"), "lib/meslam_ros", node.executable)
            assert os.access(executable, os.X_OK)


def test_a_recording_is_played_to_all_who_listen() -> None:
    player = planned(recording="room.mcap", rate="0", loop="true")["bag_player_node"]
    assert player.parameters["recording"] == "room.mcap"
    assert player.parameters["rate"] == 0.0
    assert player.parameters["loop"] is True
    assert player.parameters["subscribers"] == 2
    assert not player.essential


def test_odometry_from_elsewhere_replaces_the_odometry_node() -> None:
    nodes = planned(odometry_topic="/wheels/odom", recording="room.mcap")
    assert "odometry_node" not in nodes
    assert nodes["tracking_node"].parameters["odometry_topic"] == "/wheels/odom"
    assert nodes["bag_player_node"].parameters["subscribers"] == 1


def test_a_named_camera_has_its_topics_and_frames() -> None:
    nodes = planned(camera="meslam", camera_namespace="robot", camera_name="front")
    camera = nodes["camera_node"]
    assert camera.parameters["camera_name"] == "front"
    for node in nodes.values():
        assert dict(node.remappings)["camera/camera/color/image_raw"] == (
            "robot/front/color/image_raw"
        )
    assert nodes["tracking_node"].parameters["base_frame"] == "front_link"
    assert planned(base_frame="base_link")["tracking_node"].parameters["base_frame"] == "base_link"


def test_realsense2_camera_publishes_where_the_nodes_listen() -> None:
    """realsense2_camera publishes below /NAMESPACE/NAME."""
    nodes = planned(camera="realsense2", camera_name="front", namespace="robot", serial_no="0123")
    camera = nodes["front"]
    published = f"/{camera.namespace}/{camera.name}/color/image_raw"
    tracking = nodes["tracking_node"]
    listened = dict(tracking.remappings)["camera/camera/color/image_raw"]
    assert published == f"/{tracking.namespace}/{listened}"
    assert camera.parameters["align_depth.enable"] is True
    assert camera.parameters["serial_no"] == "0123"


def test_rviz_shows_the_system_of_a_namespace() -> None:
    rviz = planned(rviz="true", namespace="robot", camera_name="front")["rviz2"]
    assert dict(rviz.remappings)["/meslam/mesh"] == "/robot/meslam/mesh"
    assert dict(rviz.remappings)["/camera/camera/color/image_raw"] == (
        "/robot/camera/front/color/image_raw"
    )
    assert rviz.arguments[0] == "-d"
    assert Path(rviz.arguments[1]).is_file()
    assert planned(rviz="true")["rviz2"].remappings == ()
    assert planned(rviz="true", recording="a")["rviz2"].parameters["use_sim_time"] is True


def test_the_page_is_served_on_request_for_this_computer_alone() -> None:
    viewer = planned(viewer="true", camera_name="front", viewer_port="9000")["viewer_node"]
    assert viewer.parameters == {"base_frame": "front_link", "host": "127.0.0.1", "port": 9000}
    assert not viewer.essential


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"camera": "kinect"}, "realsense2"),
        ({"rviz": "yes"}, "true"),
        ({"camera": "meslam", "recording": "room.mcap"}, "give one of them"),
    ],
)
def test_wrong_arguments_are_refused_with_what_is_right(given, words) -> None:
    with pytest.raises(ValueError, match=words):
        plan(given, SHARE)


def test_what_is_planned_runs(client, tmp_path: Path) -> None:
    """A renamed camera and a namespace: every node of the plan in its own process."""
    frames = plane_frames(6)
    convert(MemoryRecording(frames), tmp_path / "plane.mcap")
    statuses: list[TrackingStatus] = []
    infos: list[CameraInfo] = []
    subscribe = client.node.create_subscription
    subscribe(TrackingStatus, "/robot/meslam/status", statuses.append, STREAM)
    subscribe(CameraInfo, "/robot/camera/front/color/camera_info", infos.append, STREAM)
    nodes = plan(
        {
            "recording": str(tmp_path / "plane.mcap"),
            "rate": "0",
            "namespace": "robot",
            "camera_name": "front",
            "export_folder": str(tmp_path),
            "map_folder": str(tmp_path),
        },
        SHARE,
    )
    processes = {
        node.name: NodeProcess(
            node.executable, node.ros_arguments, log=tmp_path / f"{node.name}.log"
        )
        for node in nodes
    }
    try:
        player = processes["bag_player_node"]
        assert client.spin_until(lambda: player.status is not None, WAIT_S)
        assert player.status == 0, player.output()
        last_ns = frames[-1].stamp_ns
        assert client.spin_until(
            lambda: bool(statuses) and stamp_ns(statuses[-1].header.stamp) == last_ns, WAIT_S
        )
        assert infos[0].header.frame_id == "front_color_optical_frame"
        assert client.call(ListRegions, "/robot/meslam/list_regions", timeout_s=WAIT_S).message
        assert {process.stop() for process in processes.values()} == {0}
    finally:
        for process in processes.values():
            process.stop()


def test_plan_needs_no_package_of_the_virtual_environment() -> None:
    """`ros2 launch` runs in the system's Python."""
    script = (
        "import sys; before = set(sys.modules); import meslam_ros.launch_plan; "
        "print(*{name.partition('.')[0] for name in set(sys.modules) - before})"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert set(result.stdout.split()) <= {*sys.stdlib_module_names, "meslam_ros"}


def launch_module() -> Any:
    """The launch file, where `launch` is there to import it."""
    for name in ("launch", "launch_ros.actions"):
        pytest.importorskip(name, reason="launch comes with a ROS installation only")
    spec = importlib.util.spec_from_file_location("meslam_launch", LAUNCH_FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_launch_file_declares_all_arguments_and_makes_the_nodes() -> None:
    module = launch_module()
    import launch
    from launch.actions import DeclareLaunchArgument, OpaqueFunction

    description = module.generate_launch_description()
    context = launch.LaunchContext()
    declared = [e for e in description.entities if isinstance(e, DeclareLaunchArgument)]
    assert {entity.name for entity in declared} == set(ARGUMENTS)
    for entity in description.entities:
        if not isinstance(entity, OpaqueFunction):
            entity.visit(context)
    context.launch_configurations["recording"] = "room.mcap"
    made = module.nodes(context)
    assert {node.node_executable for node in made} == {*SYSTEM, "bag_player_node"}
