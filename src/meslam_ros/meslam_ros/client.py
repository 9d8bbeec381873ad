"""A program's view of a running system: what it publishes, collected, and its services."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from meslam_core import se3
from meslam_core.trajectory import Trajectory
from meslam_interfaces.msg import RegionArray, TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import from_pose, stamp_ns
from meslam_ros.qos import STREAM, latched
from meslam_ros.transforms import StaticTransforms

POLL_S = 0.05


class MeslamClient:
    """Listens to a running system in a context of its own.

    Args:
        name: of the node.
        namespace: of the system.
        domain_id: of the system; by default that of the environment.

    Attributes:
        node: for further subscriptions.
        poses: T_map_base (4, 4) by stamp [ns], from /meslam/pose.
        statuses: of /meslam/status, the latest of every frame.
        path: the latest of /meslam/path.
        regions: the latest of /meslam/regions.
    """

    def __init__(
        self, name: str = "meslam_client", namespace: str = "", domain_id: int | None = None
    ) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self.node = Node(name, context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._services: dict[str, Client] = {}
        self.poses: dict[int, se3.Pose] = {}
        self.statuses: list[TrackingStatus] = []
        self.path: Path | None = None
        self.regions: RegionArray | None = None
        self._transforms = StaticTransforms(self.node)
        subscribe = self.node.create_subscription
        subscribe(PoseStamped, topics.POSE, self._take_pose, STREAM)
        subscribe(TrackingStatus, topics.STATUS, self._take_status, STREAM)
        subscribe(Path, topics.PATH, lambda m: setattr(self, "path", m), latched())
        subscribe(RegionArray, topics.REGIONS, lambda m: setattr(self, "regions", m), latched())

    def close(self) -> None:
        """Leave the system."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def __enter__(self) -> MeslamClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def spin_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Listen until a condition holds; False when the time is over first."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=POLL_S)
        return True

    def call(self, kind: Any, name: str, request: Any = None, timeout_s: float = 60.0) -> Any:
        """Call a service and return its response.

        Raises:
            TimeoutError: when the service is not there or does not answer in time.
        """
        if name not in self._services:
            # Kept, for finding the server takes longer than many an answer.
            self._services[name] = self.node.create_client(kind, name)
        client = self._services[name]
        if not self.spin_until(client.service_is_ready, timeout_s):
            raise TimeoutError(f"the service {name} is not there after {timeout_s:.0f} s")
        future = client.call_async(kind.Request() if request is None else request)
        if not self.spin_until(future.done, timeout_s):
            client.remove_pending_request(future)
            raise TimeoutError(f"the service {name} has not answered in {timeout_s:.0f} s")
        return future.result()

    @property
    def settled(self) -> bool:
        """Whether the map was refined after the last frame and is published."""
        return bool(self.statuses) and self.statuses[-1].settled

    @property
    def last_stamp_ns(self) -> int:
        """Stamp of the latest frame that has a status [ns]; 0 before the first."""
        return stamp_ns(self.statuses[-1].header.stamp) if self.statuses else 0

    @property
    def path_stamp_ns(self) -> int:
        """Stamp up to which the refined path goes [ns]; 0 before the first."""
        return stamp_ns(self.path.header.stamp) if self.path else 0

    def online_trajectory(self, T_base_camera: se3.Pose) -> Trajectory:
        """T_map_camera of every frame as it was published when the frame was done."""
        stamps = sorted(self.poses)
        return _trajectory(stamps, [self.poses[stamp] for stamp in stamps], T_base_camera)

    def refined_trajectory(self, T_base_camera: se3.Pose) -> Trajectory:
        """T_map_camera of every frame as the latest path knows it."""
        poses = self.path.poses if self.path else []
        stamps = [stamp_ns(pose.header.stamp) for pose in poses]
        return _trajectory(stamps, [from_pose(pose.pose) for pose in poses], T_base_camera)

    def mount(self, base_frame: str, optical_frame: str) -> se3.Pose | None:
        """T_base_camera (4, 4) [m] from /tf_static; None when it does not connect them."""
        return self._transforms.lookup(base_frame, optical_frame)

    def _take_status(self, message: TrackingStatus) -> None:
        """Keep a status; a frame gets another one when the map has settled after it."""
        if self.statuses and self.last_stamp_ns == stamp_ns(message.header.stamp):
            self.statuses[-1] = message
        else:
            self.statuses.append(message)

    def _take_pose(self, message: PoseStamped) -> None:
        self.poses[stamp_ns(message.header.stamp)] = from_pose(message.pose)


def _trajectory(
    stamps: list[int], T_map_base: list[se3.Pose], T_base_camera: se3.Pose
) -> Trajectory:
    poses = np.array(T_map_base, np.float64).reshape(-1, 4, 4)
    return Trajectory(np.array(stamps, np.int64), poses @ T_base_camera)
