from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.bag_builder import aligned_bag
from data.image_folders import write_folder, write_tum
from data.memory_recording import MemoryRecording
from data.synthetic_frames import PERIOD_NS, cut, depth_mm, plane_frame, plane_frames
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool

from meslam_core.camera import PinholeCamera
from meslam_core.recordings import convert
from meslam_core.slam import T_BODY_OPTICAL
from meslam_interfaces.msg import TrackingStatus
from meslam_ros import bag_player_node, topics
from meslam_ros.bag_player_node import BagPlayerNode
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import (
    NANOSECONDS,
    camera_from_info,
    color_image,
    depth_image,
    stamp_ns,
)
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM, images

COUNT = 8
FRAMES = plane_frames(COUNT)
WAIT_S = 20.0
STARTING_S = 90.0


@pytest.fixture
def recording(tmp_path: Path) -> str:
    path = tmp_path / "plane.mcap"
    convert(MemoryRecording(FRAMES), path)
    return str(path)


@pytest.fixture
def start_player(start_node) -> Callable[..., BagPlayerNode]:
    """Starts a player with one who listens to it."""
    return lambda **parameters: start_node(BagPlayerNode, **{"subscribers": 1, **parameters})


def player_arguments(parameters: Mapping[str, Any]) -> list[str]:
    return ros_arguments({"subscribers": 1, **parameters})


class Viewer:
    """Subscribes to everything that the player sends."""

    def __init__(self, client: MeslamClient, reliability=ReliabilityPolicy.RELIABLE) -> None:
        self.color: list[Image] = []
        self.depth: list[Image] = []
        self.infos: list[CameraInfo] = []
        self.clock: list[Clock] = []
        profile = images(reliability, depth=20)
        subscribe = client.node.create_subscription
        subscribe(Image, topics.COLOR, self.color.append, profile)
        subscribe(Image, topics.DEPTH, self.depth.append, profile)
        subscribe(CameraInfo, topics.COLOR_INFO, self.infos.append, profile)
        subscribe(Clock, topics.CLOCK, self.clock.append, STREAM)

    @property
    def counts(self) -> tuple[int, int, int]:
        return len(self.color), len(self.depth), len(self.infos)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_what_was_recorded_is_what_is_seen(start_player, client, recording, encoding) -> None:
    viewer = Viewer(client)
    player = start_player(recording=recording, rate=10.0, depth_encoding=encoding)
    ended: list[bool] = []
    player.stop = lambda: ended.append(True)
    assert client.spin_until(lambda: viewer.counts == (COUNT,) * 3, WAIT_S)
    assert client.spin_until(lambda: bool(ended and viewer.clock), WAIT_S)
    client.spin_until(lambda: False, 0.2)
    assert player.exit_code == 0
    for frame, color, depth, info in zip(
        FRAMES, viewer.color, viewer.depth, viewer.infos, strict=True
    ):
        assert stamp_ns(color.header.stamp) == stamp_ns(depth.header.stamp) == frame.stamp_ns
        assert color.header.frame_id == depth.header.frame_id == "camera_color_optical_frame"
        assert (color.encoding, depth.encoding) == ("rgb8", encoding)
        np.testing.assert_array_equal(color_image(color, "color"), frame.color)
        seen_mm = np.rint(1000 * depth_image(depth, "depth")).astype(int)
        np.testing.assert_array_equal(seen_mm, depth_mm(frame))
        assert camera_from_info(info, "info") == frame.camera
    ticks = [stamp_ns(clock.clock) for clock in viewer.clock]
    assert ticks == sorted(set(ticks))
    assert FRAMES[0].stamp_ns <= ticks[0]
    assert ticks[-1] == FRAMES[-1].stamp_ns
    mount = client.mount("camera_link", "camera_color_optical_frame")
    np.testing.assert_allclose(mount, T_BODY_OPTICAL, atol=1e-12)


def test_rate_keeps_the_recordings_pace(start_player, client, recording) -> None:
    viewer = Viewer(client)
    arrivals: list[float] = []
    clock = client.node.get_clock()
    client.node.create_subscription(
        CameraInfo,
        topics.COLOR_INFO,
        lambda _: arrivals.append(clock.now().nanoseconds),
        images(ReliabilityPolicy.RELIABLE),
    )
    start_player(recording=recording, rate=0.5)
    assert client.spin_until(lambda: len(arrivals) == COUNT, WAIT_S)
    expected = (COUNT - 1) * PERIOD_NS / 0.5
    assert arrivals[-1] - arrivals[0] == pytest.approx(expected, rel=0.25)
    assert viewer.counts[2] == COUNT


def test_start_step_and_number_choose_frames(start_player, client, recording) -> None:
    viewer = Viewer(client)
    start_player(
        recording=recording,
        rate=10.0,
        start=2.1 * PERIOD_NS / NANOSECONDS,
        step=2,
        frames=2,
    )
    assert client.spin_until(lambda: viewer.counts == (2,) * 3, WAIT_S)
    client.spin_until(lambda: False, 0.3)
    assert [stamp_ns(m.header.stamp) for m in viewer.color] == [
        FRAMES[4].stamp_ns,
        FRAMES[6].stamp_ns,
    ]


def test_first_image_waits_for_the_subscribers(start_player, client, recording) -> None:
    start_player(recording=recording, rate=10.0)
    client.spin_until(lambda: False, 1.0)
    viewer = Viewer(client)
    assert client.spin_until(lambda: viewer.counts == (COUNT,) * 3, WAIT_S)


def test_missing_subscribers_are_named(start_player, client, recording, capfd) -> None:
    player = start_player(recording=recording, wait_timeout_s=0.5)
    assert client.spin_until(lambda: player.exit_code == 2, WAIT_S)
    client.spin_until(lambda: False, 0.2)
    log = capfd.readouterr().err
    assert "/camera/camera/color/image_raw" in log
    assert "subscribers" in log


def test_lockstep_sends_no_more_than_was_answered(start_player, client, recording) -> None:
    viewer = Viewer(client)
    answers = client.node.create_publisher(TrackingStatus, topics.STATUS, STREAM)
    player = start_player(recording=recording, rate=0.0, window=2)
    for number in range(COUNT):
        expected = min(number + 2, COUNT)
        assert client.spin_until(lambda n=expected: len(viewer.color) == n, WAIT_S)
        client.spin_until(lambda: False, 0.1)
        assert len(viewer.color) == expected
        status = TrackingStatus()
        status.header.stamp = viewer.color[number].header.stamp
        answers.publish(status)
    assert player.exit_code == 0


def test_lockstep_without_tracking_gives_up_with_the_reason(
    start_player, client, recording, capfd
) -> None:
    Viewer(client)
    player = start_player(recording=recording, rate=0.0, wait_timeout_s=5.0)
    assert client.spin_until(lambda: player.exit_code == 2, WAIT_S)
    client.spin_until(lambda: False, 0.2)
    assert "is the tracking node running" in capfd.readouterr().err


def test_pause_and_loop(start_player, client, recording) -> None:
    viewer = Viewer(client)
    start_player(recording=recording, rate=2.0, loop=True)
    assert client.spin_until(lambda: len(viewer.color) > COUNT, WAIT_S)
    assert client.call(SetBool, "/bag_player_node/pause", SetBool.Request(data=True)).success
    client.spin_until(lambda: False, 0.3)
    count = len(viewer.color)
    client.spin_until(lambda: False, 0.5)
    assert len(viewer.color) == count
    client.call(SetBool, "/bag_player_node/pause", SetBool.Request(data=False))
    assert client.spin_until(lambda: len(viewer.color) > count, WAIT_S)
    assert stamp_ns(viewer.color[COUNT].header.stamp) == FRAMES[0].stamp_ns


def test_clock_goes_on_between_the_images_and_rests_in_a_pause(
    start_player, client, recording
) -> None:
    viewer = Viewer(client)
    start_player(recording=recording, rate=0.1)
    assert client.spin_until(lambda: len(viewer.color) >= 2, WAIT_S)
    ticks = [stamp_ns(clock.clock) for clock in viewer.clock]
    steps = np.diff(ticks)
    assert (steps > 0).all()
    assert np.median(steps) < PERIOD_NS / 4
    client.call(SetBool, "/bag_player_node/pause", SetBool.Request(data=True))
    # The image that was waited for still comes.
    client.spin_until(lambda: False, 1.0)
    count = len(viewer.clock)
    client.spin_until(lambda: False, 0.7)
    assert len(viewer.clock) == count


def test_rate_can_change_while_it_plays(start_player, client, recording) -> None:
    viewer = Viewer(client)
    player = start_player(recording=recording, rate=0.05)
    assert client.spin_until(lambda: len(viewer.color) >= 1, WAIT_S)
    started = time.monotonic()
    [result] = player.set_parameters([Parameter("rate", value=50.0)])
    assert result.successful, result.reason
    assert client.spin_until(lambda: len(viewer.color) == COUNT, WAIT_S)
    assert time.monotonic() - started < 0.5 * COUNT * PERIOD_NS / NANOSECONDS / 0.05
    [refused] = player.set_parameters([Parameter("rate", value=-1.0)])
    assert not refused.successful


def test_progress_is_shown(start_player, client, tmp_path, capfd, monkeypatch) -> None:
    monkeypatch.setattr(bag_player_node, "PROGRESS_S", 0.2)
    path = tmp_path / "plane.mcap"
    convert(MemoryRecording(FRAMES), path)
    Viewer(client)
    player = start_player(recording=str(path), rate=0.5)
    ended: list[bool] = []
    player.stop = lambda: ended.append(True)
    assert client.spin_until(lambda: bool(ended), WAIT_S)
    log = capfd.readouterr().err
    assert re.search(r"\d+ %: [2-8] of 8 image pairs, 0\.\d of 0\.3 s", log), log
    assert "played 8 image pairs" in log


def test_playback_holds_for_a_subscriber_that_hangs(client, tmp_path) -> None:
    """More images than the player keeps; none may be lost."""
    count = 100
    path = tmp_path / "long.mcap"
    convert(MemoryRecording(plane_frames(count)), path)
    listener = subprocess.Popen(
        [sys.executable, "-c", LISTENER, str(count)], stdout=subprocess.PIPE, text=True
    )
    player = NodeProcess(
        "bag_player_node",
        player_arguments({"recording": path, "rate": 5.0}),
        log=tmp_path / "player.log",
    )
    try:
        received = {int(listener.stdout.readline())}
        listener.send_signal(signal.SIGSTOP)
        assert client.spin_until(lambda: "waiting for it" in player.output(), STARTING_S)
        listener.send_signal(signal.SIGCONT)
        assert player.wait(STARTING_S) == 0, player.output()
        received |= {int(line) for line in listener.communicate(timeout=WAIT_S)[0].split()}
        assert received == {frame.stamp_ns for frame in plane_frames(count)}
    finally:
        listener.kill()
        player.stop()


LISTENER = """
import sys, rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from meslam_ros import topics
from meslam_ros.conversions import stamp_ns

count, stamps = int(sys.argv[1]), []

def take(message):
    stamps.append(stamp_ns(message.header.stamp))
    print(stamps[-1], flush=True)

rclpy.init()
node = rclpy.create_node("listener")
profile = QoSProfile(depth=count)
node.create_subscription(Image, topics.DEPTH, lambda _: None, profile)
node.create_subscription(CameraInfo, topics.COLOR_INFO, lambda _: None, profile)
node.create_subscription(Image, topics.COLOR, take, profile)
while len(stamps) < count:
    rclpy.spin_once(node, timeout_sec=1.0)
"""


def real_bag(name: str) -> Path:
    path = Path(os.environ.get("MESLAM_DATA", ""), "realsense_recordings", name)
    if not path.is_file():
        pytest.skip("MESLAM_DATA names no folder of real recordings")
    return path


@pytest.mark.parametrize("name", ["d435_sdk2.55.bag", "d435_sdk2.59.db3"])
def test_librealsense_recordings_play(start_player, client, name) -> None:
    viewer = Viewer(client)
    start_player(recording=str(real_bag(name)), rate=5.0, frames=3)
    assert client.spin_until(lambda: viewer.counts == (3,) * 3, WAIT_S)
    assert (depth_image(viewer.depth[0], "depth") > 0).mean() > 0.5


def tum_folder(path: Path) -> Path:
    folder = write_tum(path / "tum", FRAMES)
    (folder / "camera.json").write_text(json.dumps(FRAMES[0].camera.to_dict()))
    return folder


FORMATS = {
    "rosbag2 folder": lambda path: aligned_bag(FRAMES, path, "folder"),
    "mcap": lambda path: aligned_bag(FRAMES, path, "mcap"),
    "db3": lambda path: aligned_bag(FRAMES, path, "db3"),
    "ROS 1 bag": lambda path: aligned_bag(FRAMES, path, "bag"),
    "TUM": tum_folder,
    "images": lambda path: write_folder(path / "images", FRAMES),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_plays(start_player, client, tmp_path, name) -> None:
    viewer = Viewer(client)
    start_player(recording=str(FORMATS[name](tmp_path)), rate=10.0)
    assert client.spin_until(lambda: viewer.counts == (COUNT,) * 3, WAIT_S)
    for frame, color, depth in zip(FRAMES, viewer.color, viewer.depth, strict=True):
        assert stamp_ns(color.header.stamp) == frame.stamp_ns
        np.testing.assert_array_equal(color_image(color, "color"), frame.color)
        np.testing.assert_allclose(depth_image(depth, "depth"), frame.depth_m, atol=6e-4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: "", ("recording:=",)),
        (lambda folder: str(folder / "nothing.mcap"), ("nothing.mcap",)),
        (lambda folder: str(folder), ("empty",)),
    ],
)
def test_bad_recordings_are_named(start_player, tmp_path, capfd, make, words) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    player = start_player(recording=make(folder))
    assert player.exit_code == 2
    log = capfd.readouterr().err
    assert all(word in log for word in words), log


def test_truncated_recording_plays_to_the_damage_and_says_so(client, tmp_path) -> None:
    viewer = Viewer(client)
    camera = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)
    path = tmp_path / "long.mcap"
    convert(MemoryRecording([plane_frame(number, camera) for number in range(30)]), path)
    player = NodeProcess(
        "bag_player_node",
        player_arguments({"recording": cut(path, 0.7), "rate": 10.0}),
        log=tmp_path / "player.log",
    )
    assert client.spin_until(lambda: player.status is not None, STARTING_S)
    client.spin_until(lambda: False, 0.3)
    assert 0 < len(viewer.color) < 30
    assert "[bag_player_node]" in player.output()
    assert "long.mcap is truncated" in player.output()


def test_process_ends_with_the_status_of_the_contract(client, recording, tmp_path) -> None:
    viewer = Viewer(client)
    playing = NodeProcess(
        "bag_player_node",
        player_arguments({"recording": recording, "rate": 10.0}),
        log=tmp_path / "good.log",
    )
    missing = NodeProcess(
        "bag_player_node", player_arguments({"recording": "nothing"}), log=tmp_path / "bad.log"
    )
    assert client.spin_until(lambda: playing.status is not None, STARTING_S)
    assert playing.status == 0, playing.output()
    assert viewer.counts == (COUNT,) * 3
    assert "played 8 image pairs" in playing.output()
    assert missing.wait(STARTING_S) == 2
    assert "nothing" in missing.output()
    assert "Traceback" not in missing.output()
