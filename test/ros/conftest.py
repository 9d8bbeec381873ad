"""Real nodes on real DDS: in the test's process where one is enough, else in their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from data import ros_domain
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter

from meslam_ros.client import MeslamClient
from meslam_ros.managed_node import ManagedNode

ros_domain.enter()

EXECUTOR_THREADS = 4


@pytest.fixture(scope="session", autouse=True)
def ros() -> Iterator[None]:
    """The default context, for nodes in this process."""
    rclpy.init()
    yield
    rclpy.try_shutdown()


def overrides(parameters: dict[str, Any]) -> list[Parameter]:
    """Parameters as given on a command line."""
    return [Parameter(name, value=value) for name, value in parameters.items()]


@pytest.fixture
def start_node() -> Iterator[Callable[..., ManagedNode]]:
    """Starts nodes of this package and spins them in the background until the test ends."""
    running: list[tuple[ManagedNode, MultiThreadedExecutor, threading.Thread]] = []

    def start(kind: type[ManagedNode], namespace: str = "", **parameters: Any) -> ManagedNode:
        named = {name.replace("__", "."): value for name, value in parameters.items()}
        node = kind(parameter_overrides=overrides(named), namespace=namespace)
        executor = MultiThreadedExecutor(EXECUTOR_THREADS)
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        running.append((node, executor, thread))
        node.start()
        return node

    yield start
    for node, executor, thread in reversed(running):
        if not node.ended:
            node.trigger_shutdown()
        executor.shutdown()
        thread.join()
        node.destroy_node()


@pytest.fixture
def client() -> Iterator[MeslamClient]:
    """Somebody who uses the system."""
    with MeslamClient("test_client") as client:
        yield client
