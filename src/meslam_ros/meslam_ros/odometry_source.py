"""Where tracking gets its odometry from: the odometry node, another source, or nowhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from meslam_core.config import OdometryConfig
from meslam_core.errors import FrameError
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import OdometryEstimate, given_noise
from meslam_ros import topics
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.frame_worker import WARNING_PERIOD_S
from meslam_ros.odometry_messages import MAX_GAP_NS, OdometryBuffer, estimate_at
from meslam_ros.qos import STREAM, images
from meslam_ros.transforms import CameraMount, StaticTransforms

# Wheels report often, and what is lost of them is interpolated: any offer of quality will do.
GIVEN = images(ReliabilityPolicy.BEST_EFFORT, depth=100)


class OdometrySource:
    """Listens to odometry and tells it of the camera.

    Odometry from elsewhere has frames of its own. The way from its child frame to the camera comes
    from /tf_static; its parent frame is where the map is connected to.

    Args:
        node: that listens.
        topic: of odometry from elsewhere; empty for the odometry node's.
        odom_frame: of the odometry node.
        config: whether there is any, and how odometry from elsewhere errs.
        timeout_s: tells how long an image waits for its odometry [s].

    Attributes:
        odom_frame: that the latest odometry was given in.
        refused: how many images had odometry whose numbers are no pose.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        odom_frame: str,
        config: OdometryConfig,
        timeout_s: Callable[[], float],
    ) -> None:
        self.odom_frame = odom_frame
        self.refused = 0
        self._node = node
        self._timeout_s = timeout_s
        self._noise = given_noise(config) if topic else None
        self._none = not topic and config.method == "none"
        gap_ns = round(config.given_gap_s * NANOSECONDS) if topic else MAX_GAP_NS
        self._buffer = OdometryBuffer(gap_ns)
        self._last_ns: int | None = None
        self._received_in_vain: int | None = None
        self._subscription = node.create_subscription(
            Odometry, topic or topics.ODOMETRY, self._take, GIVEN if topic else STREAM
        )

    def _take(self, message: Odometry, info: Mapping[str, Any]) -> None:
        self._buffer.add(message, info["publication_sequence_number"] or 0)

    def estimate(
        self, frame: RgbdFrame, mount: CameraMount, transforms: StaticTransforms
    ) -> OdometryEstimate | None:
        """A frame's odometry, when it comes in time.

        After its source was started again the first estimate is invalid: how the camera moved
        from the last frame to this one is not known, only how it goes on from here.

        Args:
            frame: to know it of.
            mount: of the camera on the base.
            transforms: between the odometry's child frame and the camera.
        """
        try:
            estimate = self._estimate(frame, mount, transforms)
        except FrameError as error:
            self.refused += 1
            self._node.get_logger().error(
                f"{self._subscription.topic_name}: {error}; tracked without odometry",
                throttle_duration_sec=WARNING_PERIOD_S,
            )
            return None
        if estimate is None:
            return None
        last_ns, self._last_ns = self._last_ns, frame.stamp_ns
        if last_ns is None or not self._buffer.began_anew(last_ns, frame.stamp_ns):
            return estimate
        self._node.get_logger().warn("the odometry was started again: no motion to this image")
        return replace(estimate, noise=None, valid=False, reason="the odometry was started again")

    def _estimate(
        self, frame: RgbdFrame, mount: CameraMount, transforms: StaticTransforms
    ) -> OdometryEstimate | None:
        if self._none:
            return None
        log, topic = self._node.get_logger(), self._subscription.topic_name
        if not self._node.count_publishers(topic):
            log.warn(
                f"nobody publishes {topic}: tracking without odometry",
                throttle_duration_sec=10 * WARNING_PERIOD_S,
            )
            return None
        # One that was killed stays known for a while: only the first image waits for it in vain.
        silent = self._buffer.received == self._received_in_vain
        messages = self._buffer.wait(frame.stamp_ns, 0.0 if silent else self._timeout_s())
        if not messages:
            self._received_in_vain = self._buffer.received
            log.warn(
                f"no odometry came for the image at {frame.stamp_s:.3f} s: tracked without",
                throttle_duration_sec=WARNING_PERIOD_S,
            )
            return None
        if self._noise is None:
            return estimate_at(frame.stamp_ns, messages, mount)
        child = messages[-1].child_frame_id.lstrip("/")
        T_child_optical = transforms.lookup(child, mount.optical_frame)
        if T_child_optical is None:
            log.warn(
                f"{topic} is the odometry of {child!r}, which /tf_static does not connect to "
                f"{mount.optical_frame!r}: tracking without odometry. Publish the transform",
                throttle_duration_sec=WARNING_PERIOD_S,
            )
            return None
        self.odom_frame = messages[-1].header.frame_id.lstrip("/")
        place = CameraMount(child, mount.optical_frame, T_child_optical)
        estimate = estimate_at(frame.stamp_ns, messages, place)
        return None if estimate is None else replace(estimate, noise=self._noise)

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._subscription)
