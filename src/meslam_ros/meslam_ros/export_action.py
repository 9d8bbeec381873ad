"""The action that exports a mesh: it tells how far it is, and can be cancelled."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from meslam_interfaces.action import ExportMap
from meslam_ros import topics
from meslam_ros.answers import Code, RequestError, answering
from meslam_ros.mesh_requests import MeshRequests

FEEDBACK_PERIOD_S = 0.1


class ExportActionServer:
    """Serves `meslam/export`; one export runs at a time, a second goal is aborted as BUSY.

    Args:
        node: that serves; its executor needs several threads.
        requests: that write the mesh.
        log: takes the details of defects.
    """

    def __init__(self, node: Node, requests: MeshRequests, log: Callable[[str], object]) -> None:
        self._requests = requests
        self._log = log
        self._server = ActionServer(
            node,
            ExportMap,
            topics.EXPORT,
            self._execute,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def close(self) -> None:
        """Stop serving."""
        self._server.destroy()

    def _execute(self, goal: ServerGoalHandle) -> ExportMap.Result:
        reported_s = float("-inf")

        def progress(stage: str, done: int, total: int) -> None:
            nonlocal reported_s
            if goal.is_cancel_requested:
                raise RequestError(Code.CANCELLED, "cancelled; nothing was written")
            now = time.monotonic()
            if done == total or now - reported_s >= FEEDBACK_PERIOD_S:
                reported_s = now
                goal.publish_feedback(ExportMap.Feedback(stage=stage, done=done, total=total))

        def export(request: Any, result: Any) -> None:
            self._requests.export_map(request, result, progress)

        result: ExportMap.Result = answering(export, self._log)(goal.request, ExportMap.Result())
        if result.result == Code.SUCCESS:
            goal.succeed()
        elif result.result == Code.CANCELLED:
            goal.canceled()
        else:
            goal.abort()
        return result
