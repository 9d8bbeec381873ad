"""Quality of service: what each kind of topic uses, and what its publisher offers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

STREAM = QoSProfile(depth=50)
"""Reliable results a frame: poses, status, odometry."""


MODELS_DEPTH = 1000
"""Regions that may arrive at once at a late subscriber."""

UNKNOWN_NODES = {"_NODE_NAME_UNKNOWN_": "a node not known yet"}


def latched(depth: int = 1) -> QoSProfile:
    """Reliable, and kept for those who come later."""
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def images(reliability: ReliabilityPolicy, depth: int = 10) -> QoSProfile:
    """The profile of camera images with a given reliability."""
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        durability=qos_profile_sensor_data.durability,
        reliability=reliability,
    )


def matching_reliability(publishers: list[TopicEndpointInfo]) -> ReliabilityPolicy:
    """Reliable when every publisher is: a reliable reader gets nothing from best effort."""
    reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def describe(publishers: list[TopicEndpointInfo]) -> str:
    """Publishers of a topic for a message to people."""
    if not publishers:
        return "no publisher"
    offers = sorted(
        f"{UNKNOWN_NODES.get(p.node_name, p.node_name)} "
        f"({p.qos_profile.reliability.name.lower().replace('_', ' ')})"
        for p in publishers
    )
    return f"{len(offers)} publisher{'s' if len(offers) > 1 else ''}: {', '.join(offers)}"


class MatchedSubscription:
    """A subscription that begins when a publisher is there, with the publisher's reliability.

    `update` is called regularly; it subscribes, and subscribes anew when the offer changes. So it
    needs no warning of an incompatible offer, for whose handlers the executor looks on every turn.

    Attributes:
        topic: full name, remapped.
        type_name: of its messages.
        received: number of messages so far.
        lost: number of messages that its one publisher sent and that did not arrive.
    """

    def __init__(
        self, node: Node, message_type: type, topic: str, callback: Callable[[Any], None]
    ) -> None:
        self.topic = node.resolve_topic_name(topic)
        self.type_name = f"{message_type.__module__.split('.')[0]}/msg/{message_type.__name__}"
        self.received = self.lost = 0
        self._number = 0
        self._publisher_count = 0
        self._received_s = time.monotonic()
        self._node = node
        self._type = message_type
        self._callback = callback
        self._subscription: Subscription | None = None
        self._reliability: ReliabilityPolicy | None = None

    @property
    def publishers(self) -> list[TopicEndpointInfo]:
        """Who publishes the topic now."""
        return self._node.get_publishers_info_by_topic(self.topic)

    @property
    def other_types(self) -> list[str]:
        """Types that publishers of the topic send instead of the one that is wanted."""
        return sorted({p.topic_type for p in self.publishers} - {self.type_name})

    @property
    def silence_s(self) -> float:
        """Time since the last message [s]."""
        return time.monotonic() - self._received_s

    def update(self) -> None:
        """Follow the publishers that the graph shows."""
        publishers = self.publishers
        self._publisher_count = len(publishers)
        if not publishers:
            return
        reliability = matching_reliability(publishers)
        if reliability != self._reliability:
            self.close()
            self._reliability = reliability
            self._subscription = self._node.create_subscription(
                self._type,
                self.topic,
                self._received,
                images(reliability),
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )

    def close(self) -> None:
        """Stop listening; `update` starts again."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._subscription = self._reliability = None

    def _received(self, message: Any, info: Mapping[str, Any]) -> None:
        number = info["publication_sequence_number"] or 0
        # Two publishers count apart, and one that was started again begins anew.
        if self._publisher_count == 1 and 0 < self._number < number:
            self.lost += number - self._number - 1
        self._number = number
        self.received += 1
        self._received_s = time.monotonic()
        self._callback(message)
