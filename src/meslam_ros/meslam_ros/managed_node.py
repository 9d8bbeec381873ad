"""What all nodes have in common: a lifecycle that starts by itself, and a clean end."""

from __future__ import annotations

import logging
import signal
import sys
import traceback
from collections.abc import Callable
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions

from meslam_core.errors import MeslamError

STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM)
USAGE_ERROR = 2
AUTOSTART = ParameterDescriptor(
    description="configure and activate at start, without waiting for a lifecycle manager",
    additional_constraints="may be given at start alone",
    read_only=True,
)


class ManagedNode(LifecycleNode):
    """A lifecycle node; subclasses override the four steps and raise `MeslamError` to refuse one.

    Args:
        name: of the node.
        options: for `rclpy.node.Node`.

    Attributes:
        configured: whether it is configured or about to be: what it took then is in use.
        ended: whether it was shut down.
    """

    exit_code = 0

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.stop: Callable[[], None] = lambda: None
        self.ended = False
        self.configured = False
        self.autostart = bool(self.declare_parameter("autostart", True, AUTOSTART).value)

    def create_publisher(self, *args: Any, **options: Any) -> Publisher:
        """A publisher without rclpy's default event handlers.

        The executor looks at each handler on every turn, which costs more than the messages do.
        They would only warn of incompatible subscribers, and those warn themselves.
        """
        options.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **options)

    def configure(self) -> None:
        """Make what the node needs."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Stop working; what was learnt is kept."""

    def cleanup(self) -> None:
        """Undo `configure`."""

    def start(self) -> bool:
        """Configure and activate; False when one of them failed."""
        success = TransitionCallbackReturn.SUCCESS
        return self.trigger_configure() == success and self.trigger_activate() == success

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.configured = True
        result = self._step(self.configure)
        self.configured = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._step(self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._step(self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._step(self.cleanup)
        self.configured = result != TransitionCallbackReturn.SUCCESS
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        steps = {"active": (self.deactivate, self.cleanup), "inactive": (self.cleanup,)}
        for step in steps.get(state.label, ()):
            self._step(step)
        self.ended = True
        return TransitionCallbackReturn.SUCCESS

    def _step(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Run one step; rclpy itself would swallow its exceptions without a word."""
        try:
            step()
        except MeslamError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().fatal(f"{step.__name__} failed:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS


class RosLogHandler(logging.Handler):
    """Passes what the core logs on to a node's logger."""

    def __init__(self, node: ManagedNode) -> None:
        super().__init__(logging.WARNING)
        self._log = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        # rclpy allows one severity a line.
        if record.levelno >= logging.ERROR:
            self._log.error(record.getMessage())
        else:
            self._log.warn(record.getMessage())


def run(make_node: Callable[[], ManagedNode], executor_threads: int = 1) -> int:
    """Spin a node until a signal or the node itself ends it; returns the exit status."""
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        print(f"error: the ROS arguments cannot be used: {error}", file=sys.stderr)
        return USAGE_ERROR
    executor: Executor = (
        SingleThreadedExecutor()
        if executor_threads == 1
        else MultiThreadedExecutor(executor_threads)
    )
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True
        executor.wake()

    for number in STOPPING_SIGNALS:
        signal.signal(number, stop)
    try:
        node = make_node()
    except (MeslamError, ParameterException) as error:
        print(f"error: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return USAGE_ERROR
    node.stop = stop
    logging.getLogger("meslam_core").addHandler(RosLogHandler(node))
    executor.add_node(node)
    try:
        if node.autostart and not node.start():
            node.exit_code = node.exit_code or 1
            stopping = True
        while not stopping:
            executor.spin_once(timeout_sec=1.0)
    finally:
        if not node.ended:
            node.trigger_shutdown()
        executor.shutdown(timeout_sec=2.0)
        node.destroy_node()
        rclpy.try_shutdown()
    return node.exit_code
