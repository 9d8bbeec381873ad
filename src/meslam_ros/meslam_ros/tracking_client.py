"""The tracking node's service as the map server calls it."""

from __future__ import annotations

import threading

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from meslam_interfaces.srv import UseMap
from meslam_ros import topics
from meslam_ros.answers import Code, RequestError

FINDING_S = 3.0
ANSWER_S = 30.0


class TrackingClient:
    """Asks tracking to go over to a map; called from any thread but the executor's only one.

    Args:
        node: that calls.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._client = node.create_client(
            UseMap, topics.USE_MAP, callback_group=ReentrantCallbackGroup()
        )

    def is_there(self, timeout_s: float) -> bool:
        """Whether a tracking node serves, at the latest after a time [s]."""
        return self._client.wait_for_service(timeout_s)

    def use_map(self, request: UseMap.Request) -> UseMap.Response:
        """Its answer.

        Raises:
            RequestError: when there is no tracking node, or it does not answer.
        """
        if not self.is_there(FINDING_S):
            raise RequestError(
                Code.NOT_FOUND,
                f"there is no tracking node that serves {self._client.srv_name}; start one, or ask "
                "for VIEW",
            )
        answered = threading.Event()
        future = self._client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(ANSWER_S):
            self._client.remove_pending_request(future)
            raise RequestError(
                Code.BUSY, f"tracking has not answered within {ANSWER_S:.0f} s; ask again"
            )
        response: UseMap.Response = future.result()
        return response

    def close(self) -> None:
        """Stop calling."""
        self._node.destroy_client(self._client)
