"""A camera driver for tests: publishes frames as realsense2_camera does, or as a bad one."""

from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from meslam_core.frame import RgbdFrame
from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros import topics
from meslam_ros.conversions import camera_to_info, color_message, depth_message, to_stamp
from meslam_ros.qos import images
from meslam_ros.transforms import StaticBroadcaster

OPTICAL_FRAME = "camera_color_optical_frame"
BASE_FRAME = "camera_link"

Messages = tuple[CameraInfo, Image, Image]


class CameraDriver:
    """Publishers of one camera.

    Args:
        node: that publishes.
        reliability: of the images.
        mounted: whether /tf_static connects the optical frame to the base.
    """

    def __init__(
        self,
        node: Node,
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
        mounted: bool = True,
    ) -> None:
        profile = images(reliability)
        self.color = node.create_publisher(Image, topics.COLOR, profile)
        self.depth = node.create_publisher(Image, topics.DEPTH, profile)
        self.info = node.create_publisher(CameraInfo, topics.COLOR_INFO, profile)
        self.depth_info = node.create_publisher(CameraInfo, topics.DEPTH_INFO, profile)
        if mounted:
            self.static = StaticBroadcaster(node, T_BODY_OPTICAL, BASE_FRAME, OPTICAL_FRAME)

    def has_subscribers(self, count: int = 1) -> bool:
        """Whether so many nodes listen to all three topics."""
        publishers = (self.color, self.depth, self.info)
        return all(p.get_subscription_count() >= count for p in publishers)

    def send(
        self, frame: RgbdFrame, change: Callable[[Messages], None] = lambda messages: None
    ) -> int:
        """Publish a frame, changed as a test wants it; returns its stamp [ns]."""
        stamp = to_stamp(frame.stamp_ns)
        messages = self.messages(frame, stamp)
        change(messages)
        info, color, depth = messages
        self.info.publish(info)
        self.color.publish(color)
        self.depth.publish(depth)
        return frame.stamp_ns

    @staticmethod
    def messages(frame: RgbdFrame, stamp: Time) -> Messages:
        """camera_info, colour and depth of a frame."""
        return (
            camera_to_info(frame.camera, stamp, OPTICAL_FRAME),
            color_message(frame.color, stamp, OPTICAL_FRAME),
            depth_message(frame.depth_m, "16UC1", stamp, OPTICAL_FRAME),
        )
