from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyrealsense2 as rs
import pytest
from data.software_camera import (
    COLOR_F,
    FPS,
    HEIGHT,
    PERIOD_MS,
    T_COLOR_DEPTH,
    WIDTH,
    SoftwareCamera,
)
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from meslam_core import se3
from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros import topics
from meslam_ros.camera_node import CameraNode
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import color_image, depth_image, stamp_ns
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM, images, latched
from meslam_ros.realsense_camera import Devices, StreamFormat
from meslam_ros.tracking_node import TrackingNode

WAIT_S = 30.0
START_MS = 1_700_000_000_000.0
FORMAT = f"{WIDTH}x{HEIGHT}x{FPS}"
PROFILES = {"color_profile": FORMAT, "depth_profile": FORMAT}
OPTICAL = "camera_color_optical_frame"


class Port:
    """A USB port: what is plugged in now."""

    def __init__(self, *cameras: SoftwareCamera) -> None:
        self.cameras = list(cameras)

    def __call__(self) -> list[Any]:
        return [camera.device for camera in self.cameras]


class Viewer:
    """Collects what the camera sends."""

    def __init__(self, client: MeslamClient) -> None:
        self.client = client
        self.color: list[Image] = []
        self.depth: list[Image] = []
        self.infos: list[CameraInfo] = []
        self.depth_infos: list[CameraInfo] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.static: list[TFMessage] = []
        profile = images(ReliabilityPolicy.RELIABLE, depth=50)
        subscribe = client.node.create_subscription
        subscribe(Image, topics.COLOR, self.color.append, profile)
        subscribe(Image, topics.DEPTH, self.depth.append, profile)
        subscribe(CameraInfo, topics.COLOR_INFO, self.infos.append, profile)
        subscribe(CameraInfo, topics.DEPTH_INFO, self.depth_infos.append, profile)
        subscribe(DiagnosticArray, topics.DIAGNOSTICS, self.diagnostics.append, STREAM)
        subscribe(TFMessage, topics.TF_STATIC, self.static.append, latched(10))

    def until(self, condition: Callable[[], bool]) -> bool:
        return self.client.spin_until(condition, WAIT_S)

    @property
    def pairs(self) -> int:
        """Whole pairs so far."""
        return min(len(self.color), len(self.depth), len(self.infos), len(self.depth_infos))

    def whole_pairs(self) -> list[tuple[Image, Image, CameraInfo, CameraInfo]]:
        """What came with one stamp on all four topics."""
        heard = (self.color, self.depth, self.infos, self.depth_infos)
        by_stamp = [{stamp_ns(m.header.stamp): m for m in messages} for messages in heard]
        common = set.intersection(*(set(messages) for messages in by_stamp))
        return [tuple(messages[stamp] for messages in by_stamp) for stamp in sorted(common)]


@pytest.fixture
def viewer(client: MeslamClient) -> Viewer:
    return Viewer(client)


@pytest.fixture
def start_camera(start_node) -> Callable[..., CameraNode]:
    def start(port: Port, **parameters: Any) -> CameraNode:
        return start_node(partial(CameraNode, port), **{**PROFILES, **parameters})

    return start


class Shooting:
    """A camera that sends images in the background, as long as it is plugged in."""

    def __init__(self, camera: SoftwareCamera, first: int = 1, **options: Any) -> None:
        self._camera, self._number, self._options = camera, first, options
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(0.05):
            self._camera.send(self._number, START_MS + self._number * PERIOD_MS, **self._options)
            self._number += 1

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture
def shoot() -> Iterator[Callable[..., Shooting]]:
    running: list[Shooting] = []

    def start(camera: SoftwareCamera, **options: Any) -> Shooting:
        running.append(Shooting(camera, **options))
        return running[-1]

    yield start
    for shooting in running:
        shooting.stop()


def test_images_arrive_as_from_realsense2_camera(start_camera, viewer, shoot) -> None:
    camera = SoftwareCamera(T_color_depth=np.eye(4))
    start_camera(Port(camera))
    gradient = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint32).reshape(HEIGHT, WIDTH, 3) % 251
    shoot(camera, depth_m=1.234, color=gradient.astype(np.uint8))
    # One topic may be heard earlier than another: whole pairs have one stamp.
    assert viewer.until(lambda: len(viewer.whole_pairs()) >= 3)
    for color, depth, info, depth_info in viewer.whole_pairs():
        headers = [message.header for message in (color, depth, info, depth_info)]
        assert {header.frame_id for header in headers} == {OPTICAL}
        assert (color.encoding, depth.encoding) == ("rgb8", "16UC1")
        np.testing.assert_array_equal(color_image(color, "color"), gradient)
        np.testing.assert_allclose(depth_image(depth, "depth"), 1.234, atol=1e-6)
        assert (info.width, info.height, info.distortion_model) == (WIDTH, HEIGHT, "plumb_bob")
        assert list(info.d) == [0.0] * 5
        assert info.k[0] == pytest.approx(COLOR_F)
        np.testing.assert_array_equal(info.k, depth_info.k)
    stamps = [stamp_ns(message.header.stamp) for message in viewer.color]
    numbers = [round((stamp / 1e6 - START_MS) / PERIOD_MS) for stamp in stamps]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_quality_of_service_is_realsense2_cameras(start_camera, client) -> None:
    node = start_camera(Port())
    for topic in (topics.COLOR, topics.DEPTH, topics.COLOR_INFO, topics.DEPTH_INFO):
        [offer] = node.get_publishers_info_by_topic(f"/{topic}")
        assert offer.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert offer.qos_profile.durability == DurabilityPolicy.VOLATILE


def test_frames_follow_the_calibration(start_camera, viewer, shoot) -> None:
    camera = SoftwareCamera()
    start_camera(Port(camera))
    shoot(camera)
    assert viewer.until(lambda: bool(viewer.static))
    mount = viewer.client.mount("camera_link", "camera_depth_optical_frame")
    np.testing.assert_allclose(mount, T_BODY_OPTICAL, atol=1e-6)
    mount = viewer.client.mount("camera_link", OPTICAL)
    np.testing.assert_allclose(
        mount, T_BODY_OPTICAL @ se3.inverse(T_COLOR_DEPTH), atol=1e-6, err_msg="colour camera"
    )
    parents = {t.child_frame_id: t.header.frame_id for t in viewer.static[-1].transforms}
    assert parents == {
        "camera_depth_frame": "camera_link",
        "camera_depth_optical_frame": "camera_depth_frame",
        "camera_color_frame": "camera_link",
        OPTICAL: "camera_color_frame",
    }


def test_camera_name_and_a_robots_own_description(start_camera, viewer, shoot) -> None:
    camera = SoftwareCamera()
    start_camera(Port(camera), camera_name="front", publish_tf=False)
    shoot(camera)
    assert viewer.until(lambda: viewer.pairs >= 2)
    assert viewer.color[0].header.frame_id == "front_color_optical_frame"
    assert not viewer.static


def test_depth_is_where_colour_sees_it(start_camera, viewer, shoot) -> None:
    """The edge of a near wall moves on the image by f * baseline / depth."""
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.1
    camera = SoftwareCamera(T_color_depth=T_color_depth)
    start_camera(Port(camera))
    walls = np.full((HEIGHT, WIDTH), 2.0)
    walls[:, : WIDTH // 2] = 1.0
    shoot(camera, depth_m=walls)
    assert viewer.until(lambda: viewer.pairs >= 2)
    row = depth_image(viewer.depth[0], "depth")[HEIGHT // 2]
    edge = round(WIDTH / 2 + COLOR_F * 0.1 / 1.0)
    np.testing.assert_allclose(row[: edge - 1], 1.0, atol=1e-6)
    np.testing.assert_allclose(row[edge + 1 :], 2.0, atol=1e-6)


@pytest.mark.parametrize("unit_m", [0.0001, 0.001, 0.00025])
def test_depth_is_millimetres_whatever_the_cameras_unit(
    start_camera, viewer, shoot, unit_m
) -> None:
    camera = SoftwareCamera(unit_m=unit_m, T_color_depth=np.eye(4))
    start_camera(Port(camera))
    shoot(camera, depth_m=0.75)
    assert viewer.until(lambda: viewer.pairs >= 2)
    np.testing.assert_allclose(depth_image(viewer.depth[0], "depth"), 0.75, atol=1e-3)


def test_a_cameras_own_clock_becomes_this_computers(start_camera, viewer) -> None:
    camera = SoftwareCamera(domain=rs.timestamp_domain.hardware_clock)
    start_camera(Port(camera))
    before_ns = time.time_ns()
    number = 0

    def next_one() -> bool:
        nonlocal number
        number += 1
        camera.send(number, 5000.0 + number * PERIOD_MS)
        return viewer.pairs >= 4

    assert viewer.until(next_one)
    stamps = [stamp_ns(message.header.stamp) for message in viewer.color]
    assert before_ns <= stamps[0] <= time.time_ns()
    periods = np.diff(stamps) / 1e6 / PERIOD_MS
    np.testing.assert_allclose(periods, np.rint(periods), atol=1e-3)


def test_stamps_go_back_only_where_the_clock_was_set_back(start_camera, viewer, capfd) -> None:
    camera = SoftwareCamera()
    node = start_camera(Port(camera), silence_timeout_s=60.0)
    number, log = 0, ""

    def send_until(condition: Callable[[], bool], offset_ms: float) -> bool:
        def next_one() -> bool:
            nonlocal number, log
            number += 1
            camera.send(number, START_MS + number * PERIOD_MS + offset_ms)
            log += capfd.readouterr().err
            return condition()

        return viewer.until(next_one)

    def three_more() -> Callable[[], bool]:
        count = viewer.pairs + 3
        return lambda: viewer.pairs >= count

    assert send_until(three_more(), 0.0)
    # Images that nobody took in time are missing between the two.
    assert send_until(lambda: "clock went back by 359" in log, -3_600_000.0)
    assert send_until(three_more(), 0.0)
    stamps = [stamp_ns(message.header.stamp) for message in viewer.color]
    assert all(later > earlier for earlier, later in pairwise(stamps))
    node.set_parameters([Parameter("silence_timeout_s", value=0.5)])
    assert send_until(three_more(), -3_600_000.0), "an hour would have to pass"
    assert send_until(lambda: "was set back" in log, -3_600_000.0)


def test_waits_for_a_camera_and_says_so(start_camera, viewer, shoot, capfd) -> None:
    port = Port()
    start_camera(port)
    assert viewer.until(lambda: bool(viewer.diagnostics))
    assert viewer.diagnostics[0].status[0].message == "no camera"
    log = ""

    def told() -> bool:
        nonlocal log
        log += capfd.readouterr().err
        return "no RealSense camera is connected" in log

    assert viewer.until(told)
    assert "udev" in log
    camera = SoftwareCamera()
    port.cameras.append(camera)
    shoot(camera)
    assert viewer.until(lambda: viewer.pairs >= 2)
    assert viewer.until(lambda: "Software D435" in str(viewer.diagnostics[-1]))


def test_a_camera_that_is_unplugged_is_taken_again(start_camera, viewer, shoot, capfd) -> None:
    first = SoftwareCamera()
    port = Port(first)
    node = start_camera(port, silence_timeout_s=0.5)
    shooting = shoot(first)
    assert viewer.until(lambda: viewer.pairs >= 2)
    port.cameras.clear()
    shooting.stop()
    seen = viewer.pairs
    log = ""

    def told() -> bool:
        nonlocal log
        log += capfd.readouterr().err
        return "has sent nothing" in log

    assert viewer.until(told)
    again = SoftwareCamera()
    port.cameras.append(again)
    shoot(again, first=1000)
    assert viewer.until(lambda: viewer.pairs >= seen + 2)
    assert node.exit_code == 0


def test_exposure_and_emitter_are_set_and_may_change(start_camera, viewer, shoot) -> None:
    camera = SoftwareCamera()
    node = start_camera(Port(camera), auto_exposure=False, color_exposure=200)
    shoot(camera)
    assert viewer.until(lambda: viewer.pairs >= 1)
    assert camera.options == {
        "auto_exposure": 0.0,
        "depth_auto_exposure": 0.0,
        "exposure": 200.0,
        "emitter": 1.0,
    }
    node.set_parameters([Parameter("emitter", value=False), Parameter("color_exposure", value=90)])
    assert viewer.until(lambda: camera.options["emitter"] == 0.0)
    assert camera.options["exposure"] == 90.0
    [refused] = node.set_parameters([Parameter("color_profile", value="1x1x1")])
    assert not refused.successful


def test_serial_number_chooses_the_camera(start_camera, viewer, shoot) -> None:
    left, right = SoftwareCamera("100000000001"), SoftwareCamera("100000000002")
    # A number on a command line arrives as a number.
    start_camera(Port(left, right), serial_no=100000000002)
    shoot(left, depth_m=1.0)
    shoot(right, depth_m=2.0)
    assert viewer.until(lambda: viewer.pairs >= 2)
    assert depth_image(viewer.depth[0], "depth").max() == pytest.approx(2.0)


def test_a_wrong_serial_number_names_those_that_are_there(start_camera, viewer, capfd) -> None:
    start_camera(Port(SoftwareCamera("100000000001")), serial_no="5")
    log = ""

    def told() -> bool:
        nonlocal log
        log += capfd.readouterr().err
        return "100000000001" in log

    assert viewer.until(told)
    assert "serial number 5" in log


def test_a_format_that_the_camera_lacks_ends_with_those_it_has(start_camera, viewer, capfd) -> None:
    node = start_camera(Port(SoftwareCamera(usb="2.1")), color_profile="1920x1080x30")
    assert viewer.until(lambda: node.exit_code == 2)
    viewer.client.spin_until(lambda: False, 0.2)
    log = capfd.readouterr().err
    assert "no color stream 1920x1080x30" in log
    assert FORMAT in log
    assert "USB 3" in log


@pytest.mark.parametrize("text", ["640x480", "640,480,15", "0x480x15", "axbxc", ""])
def test_formats_are_checked(text) -> None:
    with pytest.raises(Exception, match="color_profile"):
        StreamFormat.parse(text, "color_profile")


def test_lifecycle_can_be_repeated(start_camera, viewer, shoot) -> None:
    camera = SoftwareCamera()
    node = start_camera(Port(camera))
    shoot(camera)
    for _ in range(3):
        seen = viewer.pairs
        assert viewer.until(lambda seen=seen: viewer.pairs >= seen + 2)
        node.trigger_deactivate()
        viewer.client.spin_until(lambda: False, 0.3)
        seen = viewer.pairs
        viewer.client.spin_until(lambda: False, 0.3)
        assert viewer.pairs == seen
        node.trigger_activate()


def test_process_waits_for_a_camera_and_ends_cleanly(client, tmp_path: Path) -> None:
    waiting = NodeProcess("camera_node", log=tmp_path / "camera.log")
    wrong = NodeProcess(
        "camera_node",
        ros_arguments({"color_profile": "big"}),
        log=tmp_path / "wrong.log",
    )
    try:
        assert client.spin_until(lambda: "no RealSense camera" in waiting.output(), WAIT_S)
        assert wrong.wait(WAIT_S) == 2
        assert "WIDTHxHEIGHTxFPS" in wrong.output()
        assert waiting.stop() == 0
        assert "Traceback" not in waiting.output() + wrong.output()
    finally:
        waiting.stop()
        wrong.stop()


@pytest.fixture
def recorded_camera() -> Devices:
    """librealsense's own file of a D435 stands in for the camera."""
    path = Path(os.environ.get("MESLAM_DATA", ""), "realsense_recordings", "d435_sdk2.55.bag")
    if not path.is_file():
        pytest.skip("MESLAM_DATA names no folder of real recordings")
    device = rs.context().load_device(str(path))
    return lambda: [device]


RECORDED = {"color_profile": "640x480x30", "depth_profile": "640x480x30"}


def test_a_real_cameras_recording(start_camera, recorded_camera, viewer) -> None:
    start_camera(recorded_camera, **RECORDED)
    assert viewer.until(lambda: viewer.pairs >= 5)
    assert viewer.infos[0].k[0] == pytest.approx(525.0, abs=1.0)
    aligned = depth_image(viewer.depth[2], "depth")
    assert aligned.shape == (480, 640)
    assert (aligned > 0).mean() > 0.5
    mount = viewer.client.mount("camera_link", OPTICAL)
    assert 0.005 < np.linalg.norm(mount[:3, 3]) < 0.1


def test_odometry_and_tracking_follow_the_camera(
    start_node, start_camera, recorded_camera, client
) -> None:
    start_node(OdometryNode)
    start_node(TrackingNode, mapping__first_iterations=50)
    start_camera(recorded_camera, **RECORDED)
    assert client.spin_until(lambda: len(client.poses) >= 5, 2 * WAIT_S)
    # Two seconds of a hand-held camera, whichever of its images a busy computer takes first.
    assert max(np.linalg.norm(T[:3, 3]) for T in client.poses.values()) < 0.5
    assert client.mount("camera_link", OPTICAL) is not None
