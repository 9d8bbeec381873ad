"""Topics whose newest message is looked up now and then; the others cost next to nothing."""

from __future__ import annotations

from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile


class _Unserved(CallbackGroup):
    """Whose messages no executor waits for or takes."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing has begun."""


class LookedUpTopic:
    """A subscription without a callback.

    A message that is never looked up is not deserialised, nor copied out of the middleware, which
    for an image takes longer than everything else about it.

    Args:
        node: that subscribes.
        kind: message type.
        name: of the topic.
        profile: its depth bounds what is kept for a look.
    """

    def __init__(self, node: Node, kind: type, name: str, profile: QoSProfile) -> None:
        self._node = node
        self._depth = max(1, profile.depth)
        self._subscription = node.create_subscription(
            kind, name, lambda _: None, profile, callback_group=_Unserved()
        )

    def news(self) -> list[Any]:
        """The messages since the last look, the newest ones if there were more than are kept."""
        messages: list[Any] = []
        subscription = self._subscription
        with subscription.handle:
            while len(messages) < self._depth:
                taken = subscription.handle.take_message(subscription.msg_type, False)
                if taken is None:
                    break
                messages.append(taken[0])
        return messages

    def newest(self) -> Any | None:
        """The newest message since the last look; None when there is none."""
        messages = self.news()
        return messages[-1] if messages else None

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)
