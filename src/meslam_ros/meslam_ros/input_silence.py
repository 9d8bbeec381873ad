"""What to tell people when no images come: the topics, who publishes them, and the likely cause."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from meslam_ros.image_synchronizer import ImageSynchronizer
from meslam_ros.node_settings import InputSettings
from meslam_ros.qos import MatchedSubscription, describe

IMAGE_TYPE = "sensor_msgs/msg/Image"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"


class InputSilence:
    """Notices when no image pair comes, and explains it, ever more seldom.

    Args:
        node: that listens.
        color, depth, info: its subscriptions.
        synchronizer: that makes pairs of the images.
        settings: how long is long, and which stamps make a pair.
    """

    def __init__(
        self,
        node: Node,
        color: MatchedSubscription,
        depth: MatchedSubscription,
        info: MatchedSubscription,
        synchronizer: ImageSynchronizer,
        settings: InputSettings,
    ) -> None:
        self._node = node
        self._images = (color, depth)
        self._subscriptions = (color, depth, info)
        self._synchronizer = synchronizer
        self._settings = settings
        self._pairs = 0
        self._last_pair_s = time.monotonic()
        self._next_report_s = settings.input_timeout_s

    def heard(self) -> None:
        """A pair has come."""
        self._pairs += 1
        self._last_pair_s = time.monotonic()

    def watch(self) -> None:
        """Warn when it is time to; called regularly."""
        silence_s = time.monotonic() - self._last_pair_s
        if silence_s < self._settings.input_timeout_s:
            self._next_report_s = self._settings.input_timeout_s
        elif silence_s >= self._next_report_s:
            self._next_report_s = 2.0 * silence_s
            self._node.get_logger().warn(self.explanation(silence_s))

    def explanation(self, silence_s: float) -> str:
        """What is missing after a silence [s], and the likely cause."""
        lines = [f"no image pair for {silence_s:.0f} s; waiting for:"]
        for subscription in self._subscriptions:
            lines.append(
                f"  {subscription.topic}: {describe(subscription.publishers)}, "
                f"{subscription.received} messages"
            )
        lines.append(f"  likely cause: {self._likely_cause()}")
        return "\n".join(lines)

    def _likely_cause(self) -> str:
        for subscription in self._subscriptions:
            if other := subscription.other_types:
                return (
                    f"{subscription.topic} carries {', '.join(other)}, expected "
                    f"{subscription.type_name}; publish that, or remap to a topic of this type"
                )
        unpublished = [s for s in self._subscriptions if not s.publishers]
        if unpublished:
            return self._unpublished(unpublished)
        mute = [s for s in self._images if not s.received]
        if mute:
            return self._mute(mute)
        if not self._pairs:
            apart = self._synchronizer.apart_s
            measured = "" if apart is None else f" (now by {apart:.3f} s)"
            return (
                f"colour and depth stamps differ{measured} by more than sync_tolerance_s = "
                f"{self._settings.sync_tolerance_s}; synchronise the two streams, or raise it"
            )
        fresh = [s.topic for s in self._images if s.silence_s < self._settings.input_timeout_s]
        if len(fresh) == 1:
            return f"only {fresh[0]} still comes, the other stream has stopped"
        if fresh:
            return (
                "images come, but their stamps do not grow or no longer make pairs; let the driver "
                "stamp each image with the time it was taken at"
            )
        return "the camera or player has paused"

    def _unpublished(self, missing: Sequence[MatchedSubscription]) -> str:
        names = ", ".join(subscription.topic for subscription in missing)
        elsewhere = self._published_images()
        if len(missing) == len(self._subscriptions):
            if self._pairs:
                return "the camera or player has ended"
            if elsewhere:
                return f"images have other names here: {', '.join(elsewhere)}; remap"
            domain = os.environ.get("ROS_DOMAIN_ID", "0")
            return (
                "the camera or player is not running, its topics have other names (remap), or it "
                f"runs in another ROS_DOMAIN_ID than {domain}"
            )
        depth = [name for name in elsewhere if "depth" in name]
        if self._images[1] in missing and depth:
            return (
                f"alignment is off: nobody publishes {self._images[1].topic}, but there is "
                f"{', '.join(depth)}; start the camera with align_depth.enable:=true, or remap"
            )
        return f"nobody publishes {names}: another name (remap), or not enabled"

    def _mute(self, mute: Sequence[MatchedSubscription]) -> str:
        names = ", ".join(subscription.topic for subscription in mute)
        offers = [info.qos_profile for s in mute for info in s.publishers]
        if any(offer.reliability == ReliabilityPolicy.BEST_EFFORT for offer in offers):
            loaded = os.environ.get(PROFILES)
            state = f"is {loaded}" if loaded else "is not set"
            return (
                f"{names}: sent as best effort, and large images get lost on their way where the "
                f"shared memory is too small: load config/fastdds.xml in both programs ({PROFILES} "
                f"{state} here), or let the camera send reliably"
            )
        return f"{names}: announced but nothing arrives; is the camera paused?"

    def _published_images(self) -> list[str]:
        """Topics of the graph with images, but for those that are waited for."""
        waited = {subscription.topic for subscription in self._subscriptions}
        return sorted(
            name
            for name, types in self._node.get_topic_names_and_types()
            if IMAGE_TYPE in types and name not in waited and self._node.count_publishers(name)
        )
