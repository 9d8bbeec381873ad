"""/diagnostics messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from meslam_ros import topics
from meslam_ros.qos import STREAM

DIAGNOSTICS_PERIOD_S = 1.0
OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)


class Diagnostics:
    """Publishes one status of a node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, STREAM)

    def report(self, level: bytes, message: str, values: Mapping[str, object]) -> None:
        """Publish a level, a sentence and figures."""
        status = DiagnosticStatus(
            level=level,
            name=f"meslam: {self._node.get_name()}",
            message=message,
            hardware_id="meslam",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)

    def close(self) -> None:
        """Stop publishing."""
        self._node.destroy_publisher(self._publisher)


def counts(counter: Counter[str]) -> str:
    """Counts for people: 'queue full: 3, unusable images: 1'; empty when nothing was counted."""
    return ", ".join(f"{name}: {number}" for name, number in sorted(counter.items()) if number)
