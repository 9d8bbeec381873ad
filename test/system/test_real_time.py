"""`slam_node` and a recording at its own pace: nothing gets lost without being told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from data import ros_domain
from diagnostic_msgs.msg import DiagnosticArray

from meslam_core.camera import PinholeCamera
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.recordings import convert
from meslam_core.simulation.simulator import simulate
from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM
from meslam_ros.slam_node import NODES

ros_domain.enter()

CAMERA = PinholeCamera(160, 120, 153.75, 153.75, 79.5, 59.5)
DURATION_S = 4.0
STARTING_S = 90.0
PLAYING_S = 120.0
DEFECTS = ("Traceback", "[FATAL]")


@pytest.fixture
def processes() -> Iterator[list[NodeProcess]]:
    started: list[NodeProcess] = []
    yield started
    for process in reversed(started):
        process.stop()


def test_every_image_pair_is_accounted_for(processes, tmp_path: Path) -> None:
    """However slow the computer is: what has no pose was dropped, and is counted."""
    simulation = simulate("room", DURATION_S, seed=5, camera=CAMERA)
    recording = tmp_path / "room.mcap"
    convert(simulation, recording)
    given = {"export_folder": tmp_path, "map_folder": tmp_path, "mapping.final_iterations": 50}
    slam = NodeProcess("slam_node", ros_arguments(given), log=tmp_path / "slam_node.log")
    processes.append(slam)
    reports: list[DiagnosticArray] = []
    with MeslamClient("real_time_test") as client:
        client.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, reports.append, STREAM)
        heard = [client.node.resolve_topic_name(name) for name in (topics.POSE, topics.STATUS)]
        assert client.spin_until(
            lambda: (
                set(NODES) <= set(client.node.get_node_names())
                and all(client.node.count_publishers(name) for name in heard)
            ),
            STARTING_S,
        ), slam.output()
        playing = {"recording": recording, "subscribers": 2, "wait_timeout_s": STARTING_S}
        player = NodeProcess("bag_player_node", ros_arguments(playing), log=tmp_path / "player.log")
        processes.append(player)
        assert client.spin_until(lambda: player.status is not None, STARTING_S + PLAYING_S)
        assert player.status == 0, player.output()
        assert client.spin_until(lambda: client.settled, PLAYING_S), slam.output()
        T_base_camera = client.mount("camera_link", "camera_color_optical_frame")

    last = client.statuses[-1]
    assert last.frames_received == len(simulation), last.drop_reasons
    untracked = sum(status.state == TrackingStatus.LOST for status in client.statuses)
    assert last.frames_tracked + last.frames_dropped + untracked == len(simulation)
    assert len(client.poses) == last.frames_tracked
    assert bool(last.drop_reasons) == (last.frames_dropped > 0)
    tracked = [status for status in client.statuses if status.state == TrackingStatus.OK]
    assert all(0.0 < status.latency_s < PLAYING_S for status in tracked)
    assert set(client.poses) <= set(simulation.stamps_ns.tolist())
    if not last.frames_dropped:
        online = client.online_trajectory(T_base_camera)
        assert absolute_error(online, simulation.truth).rmse_m < 0.06
    names = {status.name for report in reports for status in report.status}
    assert {f"meslam: {name}" for name in NODES} <= names
    latencies = np.array([status.latency_s for status in client.statuses])
    assert np.all(np.isfinite(latencies))
    slam.stop()
    assert not any(word in slam.output() + player.output() for word in DEFECTS), slam.output()
