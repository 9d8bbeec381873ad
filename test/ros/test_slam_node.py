from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from meslam_interfaces.srv import ListRegions
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.processes import NodeProcess
from meslam_ros.slam_node import NODES, child_arguments, needed_nodes

ROOT = Path(__file__).parents[2]
STARTING_S = 60.0
ENDING_S = 20.0


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., NodeProcess]]:
    started: list[NodeProcess] = []

    def run(*arguments: str) -> NodeProcess:
        log = tmp_path / f"slam_node.{len(started)}.log"
        started.append(NodeProcess("slam_node", arguments, log=log))
        return started[-1]

    yield run
    for process in started:
        process.stop()


def children(pid: int) -> dict[str, int]:
    """Process numbers of the nodes that a process has started, by the nodes' names."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_bytes().split(b"\0")
        except (OSError, IndexError):
            continue
        names = [name for name in NODES if f"meslam_ros.{name}".encode() in command]
        if parent == pid and names:
            found[names[0]] = int(entry.name)
    return found


def alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.1)
    return False


def node_names(client: MeslamClient) -> list[str]:
    return sorted(client.node.get_node_names())


def test_arguments_reach_every_node_but_for_a_name() -> None:
    given = ["--ros-args", "-r", "__node:=slam", "-r", "__ns:=/robot", "-p", "queue_size:=3"]
    assert child_arguments(given) == ["--ros-args", "-r", "__ns:=/robot", "-p", "queue_size:=3"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["-p", "odometry_topic:=/wheels/odom"],
        ["-p", "tracking_node:odometry_topic:=/wheels/odom"],
        ["-p", "odometry.method:=none"],
        ["--params-file", str(ROOT / "config" / "imap_star.yaml")],
    ],
)
def test_odometry_from_elsewhere_or_none_needs_no_odometry_node(arguments) -> None:
    assert "odometry_node" not in needed_nodes(["--ros-args", *arguments])


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--ros-args", "--params-file", str(ROOT / "config" / "meslam.yaml")],
        # The nodes say themselves what is wrong with their parameters.
        ["--ros-args", "-p", "odometry_topic:=true"],
        ["--ros-args", "--params-file", "/nowhere.yaml"],
    ],
)
def test_otherwise_all_nodes_are_needed(arguments) -> None:
    assert needed_nodes(arguments) == NODES


def test_no_odometry_node_runs_beside_wheels(start) -> None:
    slam = start("--ros-args", "-p", "odometry_topic:=/wheels/odom")
    assert wait_until(lambda: len(children(slam.pid)) == 3, STARTING_S), slam.output()
    assert "odometry_node" not in children(slam.pid)


def test_four_nodes_start_restart_and_end_together(start, client) -> None:
    slam = start("--ros-args", "-r", "__ns:=/robot", "-p", "input_timeout_s:=0.6")
    # Names, topics and parameters are those of the single nodes, in the namespace asked for.
    assert client.spin_until(lambda: set(NODES) <= set(node_names(client)), STARTING_S), (
        slam.output()
    )
    answer = client.call(ListRegions, f"/robot/{topics.LIST_REGIONS}", timeout_s=STARTING_S)
    assert answer.result == answer.SUCCESS
    assert wait_until(
        lambda: "/robot/camera/camera/color/image_raw: no publisher" in slam.output(), STARTING_S
    )

    first = children(slam.pid)
    assert sorted(first) == sorted(NODES)
    os.kill(first["region_manager_node"], signal.SIGKILL)

    def restarted() -> bool:
        now = children(slam.pid)
        return now.get("region_manager_node", 0) not in (0, first["region_manager_node"])

    assert wait_until(restarted, STARTING_S)
    # Said only once the new process runs, which may already have been seen.
    assert wait_until(lambda: "region_manager_node crashed" in slam.output(), STARTING_S)

    last = children(slam.pid)
    assert {n: p for n, p in last.items() if n != "region_manager_node"} == {
        n: p for n, p in first.items() if n != "region_manager_node"
    }
    slam.signal(signal.SIGINT)
    assert slam.wait(ENDING_S) == 0
    assert not any(alive(pid) for pid in last.values())
    assert "Traceback" not in slam.output()


def test_nodes_end_when_their_parent_is_killed(start) -> None:
    slam = start()
    assert wait_until(lambda: len(children(slam.pid)) == len(NODES), STARTING_S)
    nodes = children(slam.pid)
    slam.signal(signal.SIGKILL)
    assert wait_until(lambda: not any(alive(pid) for pid in nodes.values()), ENDING_S)


def test_bad_parameter_ends_everything_with_its_name(start) -> None:
    slam = start("--ros-args", "-p", "tracking.points:=1")
    assert slam.wait(STARTING_S) == 2
    assert "tracking.points = 1" in slam.output()
    assert children(slam.pid) == {}
