"""The built workspace: what is installed where, and that a shell set up by env.bash has it all."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from ament_index_python.packages import (
    get_package_prefix,
    get_package_share_directory,
    get_packages_with_prefixes,
)

ROOT = Path(__file__).resolve().parents[2]
INTERFACES = ROOT / "src" / "meslam_interfaces"
NODES = (
    "odometry_node",
    "tracking_node",
    "region_manager_node",
    "map_server_node",
    "slam_node",
    "bag_player_node",
    "camera_node",
    "call_service",
)
# From the metadata that ROS 2 Jazzy's own rosbag2 writes.
JAZZY_TF_MESSAGE_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


def run_in_shell(script: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a bash script with nothing but the system's own environment and the given variables."""
    return subprocess.run(
        ["bash", "--norc", "-c", script],
        cwd=cwd,
        env={"HOME": str(Path.home()), "PATH": "/usr/local/bin:/usr/bin:/bin", **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("package", ["meslam_core", "meslam_interfaces", "meslam_ros", "tf2_msgs"])
def test_package_is_in_the_ament_index(package: str) -> None:
    assert package in get_packages_with_prefixes()
    assert (Path(get_package_share_directory(package)) / "package.xml").is_file()


@pytest.mark.parametrize("node", NODES)
def test_node_is_an_executable_of_the_package(node: str) -> None:
    executable = Path(get_package_prefix("meslam_ros"), "lib", "meslam_ros", node)
    assert os.access(executable, os.X_OK)
    interpreter = executable.read_text().splitlines()[0].removeprefix("#!")
    assert Path(interpreter).parent == Path(sys.prefix) / "bin"


def test_share_holds_the_configuration() -> None:
    share = Path(get_package_share_directory("meslam_ros"))
    assert (share / "config" / "fastdds.xml").samefile(ROOT / "config" / "fastdds.xml")


def test_command_is_on_the_path() -> None:
    command = shutil.which("meslam")
    assert command is not None
    assert Path(command).is_relative_to(get_package_prefix("meslam_core"))


def test_tf_message_has_the_type_hash_of_jazzy() -> None:
    share = Path(get_package_share_directory("tf2_msgs"))
    hashes = json.loads((share / "msg" / "TFMessage.json").read_text())["type_hashes"]
    assert {h["type_name"]: h["hash_string"] for h in hashes}[
        "tf2_msgs/msg/TFMessage"
    ] == JAZZY_TF_MESSAGE_HASH


def test_every_service_answers_with_the_same_codes() -> None:
    codes = {}
    for path in sorted(INTERFACES.glob("srv/*.srv")):
        answer = path.read_text().split("\n---\n")[1]
        codes[path.name] = re.findall(r"^uint8 ([A-Z_]+) *= *(\d+)", answer, re.MULTILINE)
        assert re.search(r"^string message\b", answer, re.MULTILINE), path.name
    expected = codes["ExportMap.srv"]
    assert ("SUCCESS", "0") in expected
    assert all(found == expected for found in codes.values()), codes


@pytest.mark.parametrize(
    "path", sorted(INTERFACES.glob("*/*.*")), ids=lambda path: f"{path.parent.name}/{path.name}"
)
def test_every_field_is_explained(path: Path) -> None:
    lines = [line for line in path.read_text().splitlines() if line and line != "---"]
    assert lines[0].startswith("#"), "the file does not say what it is for"
    bare = [line for line in lines if "#" not in line and not line.startswith("string FORMAT")]
    assert not bare


SHOW = 'for name in PATH AMENT_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH; do echo "${!name}"; done'


def test_sourcing_twice_changes_nothing_and_says_nothing(tmp_path: Path) -> None:
    once = run_in_shell(f"set -eu; source '{ROOT}/env.bash'; {SHOW}", tmp_path)
    twice = run_in_shell(
        f"set -eu; for i in 1 2; do source '{ROOT}/env.bash'; done; {SHOW}", tmp_path
    )
    assert once.returncode == 0
    assert once.stderr == twice.stderr == ""
    assert once.stdout == twice.stdout


def test_sourcing_keeps_the_options_and_the_profile_of_the_user(tmp_path: Path) -> None:
    script = f"source '{ROOT}/env.bash'; echo $- $FASTRTPS_DEFAULT_PROFILES_FILE"
    result = run_in_shell(f"set -u; {script}", tmp_path, FASTRTPS_DEFAULT_PROFILES_FILE="/my.xml")
    options, profile = result.stdout.split()
    assert "u" in options
    assert profile == "/my.xml"
    options, profile = run_in_shell(script, tmp_path).stdout.split()
    assert "u" not in options
    assert profile == str(ROOT / "config" / "fastdds.xml")


def test_sourcing_before_the_setup_names_the_remedy(tmp_path: Path) -> None:
    shutil.copy(ROOT / "env.bash", tmp_path)
    result = run_in_shell("source env.bash || echo failed with $?", tmp_path)
    assert result.stdout == "failed with 1\n"
    assert "make setup" in result.stderr


TALKER = """
import time, rclpy
from rclpy.qos import QoSProfile, DurabilityPolicy
from meslam_interfaces.msg import RegionModel
rclpy.init()
node = rclpy.create_node("talker")
qos = QoSProfile(depth=4, durability=DurabilityPolicy.TRANSIENT_LOCAL)
publisher = node.create_publisher(RegionModel, "models", qos)
publisher.publish(RegionModel(map_id="m", index=[1, 2, -3], version=7, data=bytes(range(9)) * 9999))
input()
"""


def test_a_region_model_reaches_another_process() -> None:
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile

    from meslam_interfaces.msg import RegionModel

    domain = 60 + os.getpid() % 40
    talker = subprocess.Popen(
        [sys.executable, "-c", TALKER],
        stdin=subprocess.PIPE,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
    )
    context = rclpy.Context()
    context.init(domain_id=domain)
    try:
        node = rclpy.create_node("listener", context=context)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        received = rclpy.task.Future(executor=executor)
        qos = QoSProfile(depth=4, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(RegionModel, "models", received.set_result, qos)
        executor.spin_until_future_complete(received, timeout_sec=20)
        model = received.result()
    finally:
        context.shutdown()
        talker.communicate(b"\n", timeout=20)
    assert model.map_id == "m"
    assert list(model.index) == [1, 2, -3]
    assert bytes(model.data) == bytes(range(9)) * 9999
