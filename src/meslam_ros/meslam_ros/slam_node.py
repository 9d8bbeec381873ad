"""`slam_node`: all nodes that are needed at once, each in a process of its own."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Sequence

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from meslam_core.errors import MeslamError
from meslam_ros.managed_node import USAGE_ERROR
from meslam_ros.node_settings import TrackingSettings
from meslam_ros.parameters import declare_config, declare_settings
from meslam_ros.processes import STOPPING_S, NodeProcess

NODES = ("map_server_node", "region_manager_node", "odometry_node", "tracking_node")
MAX_RESTARTS = 3
RESTART_WINDOW_S = 60.0
POLL_S = 0.1


def child_arguments(arguments: Sequence[str]) -> list[str]:
    """The arguments that all nodes get: those given, but for a name, which would be everyone's."""
    kept: list[str] = []
    for argument in arguments:
        if not argument.startswith("__node:="):
            kept.append(argument)
        elif kept and kept[-1] in ("-r", "--remap"):
            kept.pop()
    return kept


def needed_nodes(arguments: Sequence[str]) -> tuple[str, ...]:
    """Those of `NODES` that the arguments leave something to do.

    rcl itself tells what the tracking node would be given, by command line or parameter file.

    Args:
        arguments: for all nodes.
    """
    context = Context()
    try:
        rclpy.init(
            args=[sys.argv[0], *arguments],
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        node = Node(
            "tracking_node", context=context, enable_rosout=False, start_parameter_services=False
        )
        given = declare_settings(node, TrackingSettings).odometry_topic
        method = declare_config(node, ("odometry",)).odometry.method
        node.destroy_node()
    except (MeslamError, ParameterException, RuntimeError):
        # The nodes themselves say what is wrong.
        return NODES
    finally:
        context.try_shutdown()
    if given or method == "none":
        return tuple(name for name in NODES if name != "odometry_node")
    return NODES


class Child:
    """One node, started again when it crashes, but not for ever.

    Args:
        name: of the node.
        arguments: for it.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self._arguments = arguments
        self._restarts: list[float] = []
        self.process = NodeProcess(name, arguments)

    def restart(self) -> bool:
        """Start it again; False when it has crashed too often lately."""
        now = time.monotonic()
        self._restarts = [t for t in self._restarts if now - t < RESTART_WINDOW_S]
        if len(self._restarts) >= MAX_RESTARTS:
            return False
        self._restarts.append(now)
        self.process = NodeProcess(self.name, self._arguments)
        return True


class Supervisor:
    """Starts the nodes, restarts those that crash, and ends them all."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self._arguments = child_arguments(arguments)
        self._children: list[Child] = []
        self._stopping = threading.Event()

    def stop(self, *_: object) -> None:
        """End at the next opportunity; a signal handler."""
        self._stopping.set()

    def run(self) -> int:
        """Run until a signal, or a node that cannot be kept running; the exit status."""
        status = 0
        try:
            self._children = [
                Child(name, self._arguments) for name in needed_nodes(self._arguments)
            ]
            while status == 0 and not self._stopping.wait(POLL_S):
                status = self._check()
        finally:
            self._end()
        return status

    def _check(self) -> int:
        """Restart what crashed; the status to end with, 0 to go on."""
        for child in self._children:
            status = child.process.status
            if status is None:
                continue
            if status == USAGE_ERROR:
                return USAGE_ERROR
            if status == 0:
                _say(f"{child.name} has ended, so everything ends")
                return 1
            if not child.restart():
                _say(f"{child.name} crashed {MAX_RESTARTS + 1} times within a minute; giving up")
                return 1
            _say(f"{child.name} crashed with status {status}; it is started again")
        return 0

    def _end(self) -> None:
        """Ask all nodes to end at once, and insist after a while."""
        for child in self._children:
            child.process.signal(signal.SIGTERM)
        deadline = time.monotonic() + STOPPING_S
        for child in self._children:
            child.process.stop(max(deadline - time.monotonic(), 0.1))


def _say(message: str) -> None:
    print(f"[slam_node] {message}", file=sys.stderr, flush=True)


def main() -> None:
    """Entry point."""
    supervisor = Supervisor(sys.argv[1:])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, supervisor.stop)
    sys.exit(supervisor.run())


if __name__ == "__main__":
    main()
