"""What a node says when nothing comes: for each cause the message that names it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from builtin_interfaces.msg import Time
from data.ros_camera import BASE_FRAME, OPTICAL_FRAME, CameraDriver, Messages
from data.textured_room import frame_at, path
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tf2_msgs.msg import TFMessage

from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, stamp_ns, to_stamp, to_transform
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import STREAM, images

ANSWER_S = 30.0
POSES = path(12)
Said = Callable[..., str]


@pytest.fixture
def said(start_node, client: MeslamClient, capfd) -> Said:
    """Waits until the log of a node holds all words, and returns it."""
    start_node(OdometryNode, input_timeout_s=0.5, transform_timeout_s=0.3)
    heard: list[str] = [""]

    def wait(*words: str, meanwhile: Callable[[], object] = lambda: None) -> str:
        def complete() -> bool:
            meanwhile()
            heard[0] += capfd.readouterr().err
            return all(word in heard[0] for word in words)

        assert client.spin_until(complete, ANSWER_S), heard[0]
        return heard[0]

    return wait


class Sender:
    """Sends one frame after the other, changed as a cause wants it."""

    def __init__(self, client: MeslamClient, **options) -> None:
        self.driver = CameraDriver(client.node, **options)
        self._number = 0

    def send(self, change: Callable[[Messages], None] = lambda messages: None) -> None:
        self._number += 1
        frame = frame_at(POSES[self._number % len(POSES)], self._number)
        self.driver.send(replace(frame, stamp_ns=frame.stamp_ns + NANOSECONDS), change)


def test_nothing_runs(said: Said) -> None:
    said("no image pair", f"/{topics.COLOR}: no publisher", "not running", "ROS_DOMAIN_ID")


def test_images_have_other_names(said: Said, client) -> None:
    for name in ("oak/rgb", "oak/stereo"):
        client.node.create_publisher(Image, name, STREAM)
    said("likely cause: images have other names here: /oak/rgb, /oak/stereo; remap")


def test_depth_is_not_aligned(said: Said, client) -> None:
    client.node.create_publisher(Image, topics.COLOR, STREAM)
    client.node.create_publisher(CameraInfo, topics.COLOR_INFO, STREAM)
    client.node.create_publisher(Image, "camera/camera/depth/image_rect_raw", STREAM)
    said(
        "likely cause: alignment is off",
        f"/{topics.DEPTH}",
        "/camera/camera/depth/image_rect_raw",
        "align_depth.enable:=true",
    )


def test_camera_info_is_missing_before_any_image(said: Said, client) -> None:
    for name in (topics.COLOR, topics.DEPTH):
        client.node.create_publisher(Image, name, STREAM)
    said(f"likely cause: nobody publishes /{topics.COLOR_INFO}")


def test_camera_info_is_missing_while_images_come(said: Said, client) -> None:
    profile = images(ReliabilityPolicy.RELIABLE)
    color = client.node.create_publisher(Image, topics.COLOR, profile)
    depth = client.node.create_publisher(Image, topics.DEPTH, profile)

    def send() -> None:
        for place in range(2):
            number = client.node.get_clock().now().nanoseconds + place
            frame = frame_at(POSES[0], 0)
            _, *pair = CameraDriver.messages(frame, to_stamp(number))
            for publisher, message in zip((color, depth), pair, strict=True):
                publisher.publish(message)

    said(f"no camera_info has come on /{topics.COLOR_INFO} (no publisher)", meanwhile=send)


def test_a_topic_carries_something_else(said: Said, client) -> None:
    client.node.create_publisher(CompressedImage, topics.COLOR, STREAM)
    said(f"/{topics.COLOR} carries sensor_msgs/msg/CompressedImage, expected sensor_msgs/msg/Image")


@pytest.mark.parametrize(
    ("reliability", "words"),
    [
        (ReliabilityPolicy.BEST_EFFORT, ("(best effort)", "fastdds.xml", "reliably")),
        (ReliabilityPolicy.RELIABLE, ("(reliable)", "announced but nothing arrives", "paused")),
    ],
)
def test_announced_images_do_not_arrive(said: Said, client, reliability, words) -> None:
    CameraDriver(client.node, reliability=reliability)
    said("test_client", *words)


def test_stamps_make_no_pairs(said: Said, client) -> None:
    sender = Sender(client)

    def later(messages: Messages) -> None:
        depth = messages[2]
        depth.header.stamp = to_stamp(stamp_ns(depth.header.stamp) + NANOSECONDS // 2)

    assert client.spin_until(sender.driver.has_subscribers, ANSWER_S)
    said(
        "stamps differ (now by 0.", "sync_tolerance_s = 0.02", meanwhile=lambda: sender.send(later)
    )


def test_one_stream_stops(said: Said, client) -> None:
    sender = Sender(client)
    assert client.spin_until(sender.driver.has_subscribers, ANSWER_S)
    sender.send()

    def color_alone() -> None:
        message = Image()
        message.header.stamp = Time(sec=5)
        sender.driver.color.publish(message)

    said(f"only /{topics.COLOR} still comes", meanwhile=color_alone)


def test_the_camera_is_paused(said: Said, client) -> None:
    sender = Sender(client)
    assert client.spin_until(sender.driver.has_subscribers, ANSWER_S)
    sender.send()
    said("has paused", "1 messages")


def test_the_transform_to_the_base_is_missing(said: Said, client) -> None:
    sender = Sender(client, mounted=False)
    assert client.spin_until(sender.driver.has_subscribers, ANSWER_S)
    sender.send()
    log = said("/tf_static does not connect", OPTICAL_FRAME, BASE_FRAME, "set base_frame")
    assert "volatile" not in log


def test_the_transform_is_sent_with_the_wrong_quality(said: Said, client) -> None:
    """Volatile, as a plain publisher does it: a latched subscription is not served."""
    static = client.node.create_publisher(TFMessage, topics.TF_STATIC, QoSProfile(depth=1))
    transform = to_transform(T_BODY_OPTICAL, Time(), BASE_FRAME, OPTICAL_FRAME)
    static.publish(TFMessage(transforms=[transform]))
    sender = Sender(client, mounted=False)
    assert client.spin_until(sender.driver.has_subscribers, ANSWER_S)
    sender.send()
    said("/tf_static does not connect", "test_client", "volatile", "transient local")
