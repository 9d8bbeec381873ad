"""The system driven by the stock `ros2` command line, where a ROS installation brings it."""

from __future__ import annotations

import importlib.util
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from data import ros_domain
from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path

from meslam_core.recordings import convert
from meslam_ros.launch_plan import ARGUMENTS, SYSTEM

ros_domain.enter()

NEEDED = ("ros2cli", "ros2launch", "ros2run", "ros2service", "ros2topic", "ros2param")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]
STARTING_S = 90.0

pytestmark = pytest.mark.skipif(
    bool(MISSING) or shutil.which("ros2") is None,
    reason=f"the ros2 command line comes with a ROS installation only ({', '.join(MISSING)})",
)


def ros2(*arguments: str, timeout_s: float = 60.0) -> str:
    """Output of a ros2 command that must succeed."""
    result = subprocess.run(
        ["ros2", *arguments], capture_output=True, text=True, timeout=timeout_s, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def system(tmp_path_factory) -> Iterator[Path]:
    """The launch file's nodes with a short recording that is played again and again."""
    folder = tmp_path_factory.mktemp("ros2")
    frames = [frame_at(pose, number) for number, pose in enumerate(path(60), start=1)]
    convert(MemoryRecording(frames), folder / "room.mcap")
    arguments = {
        "recording": str(folder / "room.mcap"),
        "loop": "true",
        "export_folder": str(folder),
        "map_folder": str(folder),
    }
    log = (folder / "launch.log").open("w")
    process = subprocess.Popen(
        ["ros2", "launch", "meslam_ros", "meslam.launch.py"]
        + [f"{name}:={value}" for name, value in arguments.items()],
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    try:
        ros2("topic", "echo", "--once", "/meslam/status", timeout_s=STARTING_S)
        yield folder
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(30)
        finally:
            process.kill()
            log.close()


def test_executables_are_found() -> None:
    listed = ros2("pkg", "executables", "meslam_ros").split()
    assert {*SYSTEM, "slam_node", "bag_player_node", "camera_node"} <= set(listed)


def test_launch_file_shows_its_arguments() -> None:
    shown = ros2("launch", "meslam_ros", "meslam.launch.py", "--show-args")
    assert set(re.findall(r"'(\w+)':", shown)) >= set(ARGUMENTS)


def test_nodes_and_topics_are_there(system: Path) -> None:
    assert {f"/{name}" for name in SYSTEM} <= set(ros2("node", "list").split())
    assert "geometry_msgs/msg/PoseStamped" in ros2("topic", "info", "/meslam/pose")
    assert "frame_id: map" in ros2("topic", "echo", "--once", "/meslam/pose")


def test_services_answer(system: Path) -> None:
    kind = "meslam_interfaces/srv/SaveMap"
    deadline = time.monotonic() + STARTING_S
    while "result=0" not in (answer := ros2("service", "call", "/meslam/save_map", kind)):
        assert time.monotonic() < deadline, answer
    assert list(system.iterdir())


def test_parameters_are_described_and_guarded(system: Path) -> None:
    assert "keyframes" in ros2("param", "describe", "/tracking_node", "keyframes.translation_m")
    refused = subprocess.run(
        ["ros2", "param", "set", "/tracking_node", "map_frame", "world"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "cannot change" in refused.stdout + refused.stderr


def test_lifecycle_is_managed(system: Path) -> None:
    assert "active" in ros2("lifecycle", "get", "/map_server_node")


def test_ros2_run_starts_a_node(system: Path) -> None:
    result = subprocess.run(
        ["ros2", "run", "meslam_ros", "bag_player_node"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 2
    assert "which recording?" in result.stderr + result.stdout
