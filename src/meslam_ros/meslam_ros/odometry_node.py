"""`odometry_node`: images to /meslam/odom and the transform from odom to base."""

from __future__ import annotations

import sys
import time
from typing import Any

from nav_msgs.msg import Odometry

from meslam_core.errors import ConfigError
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import OdometryEstimate, make_odometry
from meslam_core.threads import limit_threads
from meslam_ros import topics
from meslam_ros.conversions import from_pose
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, ERROR, OK, STALE, WARN, Diagnostics, counts
from meslam_ros.frame_worker import WARNING_PERIOD_S, FrameWorker
from meslam_ros.image_synchronizer import ImagePair
from meslam_ros.managed_node import ManagedNode, run
from meslam_ros.node_settings import FrameSettings, InputSettings, OdometrySettings
from meslam_ros.odometry_messages import BaseMotion
from meslam_ros.parameters import declare_config, declare_settings, read_config
from meslam_ros.qos import STREAM
from meslam_ros.rgbd_input import STEADY
from meslam_ros.transforms import CameraMount, TransformBroadcaster


class OdometryNode(ManagedNode):
    """Estimates the base's motion from image to image."""

    def __init__(self, **options: Any) -> None:
        super().__init__("odometry_node", **options)
        self._frames = declare_settings(self, FrameSettings)
        self._inputs = declare_settings(self, InputSettings)
        self._settings = declare_settings(self, OdometrySettings)
        self._config = declare_config(self, ("sensor", "odometry", "runtime"))
        self._check_method()

    def configure(self) -> None:
        self._config = read_config(self)
        self._check_method()
        limit_threads(self._config.runtime.threads, load_open3d=False)
        self._broadcaster = TransformBroadcaster(self)
        self._diagnostics = Diagnostics(self)

    def activate(self) -> None:
        self._begin()
        # Another publisher tells those who listen that these poses do not continue earlier ones.
        self._publisher = self.create_publisher(Odometry, topics.ODOMETRY, STREAM)
        self._worker = FrameWorker(
            self, self._inputs, self._frames, lambda: self._settings.odometry_queue_size, self
        )
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY)

    def deactivate(self) -> None:
        self.destroy_timer(self._timer)
        self._worker.close()
        self.destroy_publisher(self._publisher)

    def cleanup(self) -> None:
        self._diagnostics.close()
        self._broadcaster.close()

    def _check_method(self) -> None:
        if self._config.odometry.method == "none":
            raise ConfigError(
                "odometry.method = none leaves nothing to do for odometry_node; do not start it"
            )

    def _begin(self) -> None:
        self._odometry = make_odometry(self._config.odometry, self._config.sensor)
        self._motion = BaseMotion(self._frames.odom_frame)
        self._latest: OdometryEstimate | None = None
        self._duration_ms = 0.0

    def restart(self, reason: str) -> None:
        """Begin anew at the origin (`FrameConsumer`)."""
        self.get_logger().warn(f"{reason}; the odometry begins anew")
        self._begin()

    def process(self, frame: RgbdFrame, mount: CameraMount, pair: ImagePair) -> None:
        """Register a frame and publish (`FrameConsumer`)."""
        started = time.perf_counter()
        estimate = self._odometry.process(frame)
        self._duration_ms = (time.perf_counter() - started) * 1e3
        self._latest = estimate
        message = self._motion.message(estimate, mount)
        self._publisher.publish(message)
        T_odom_base = from_pose(message.pose.pose)
        root = self._worker.input.transforms.root(mount.base_frame)
        T_base_root = self._worker.input.transforms.lookup(mount.base_frame, root)
        assert T_base_root is not None
        self._broadcaster.send(
            T_odom_base @ T_base_root, frame.stamp_ns, self._frames.odom_frame, root
        )
        if not estimate.valid:
            self.get_logger().warn(
                f"odometry is not to be trusted: {estimate.reason}",
                throttle_duration_sec=WARNING_PERIOD_S,
            )

    def refuse(self, pair: ImagePair, reason: str) -> None:
        """Nothing to publish without a frame (`FrameConsumer`)."""

    def idle(self, silence_s: float) -> None:
        """Nothing to do without images (`FrameConsumer`)."""

    def _diagnose(self) -> None:
        worker, latest = self._worker, self._latest
        level, message = STALE, "no images yet"
        if latest is not None:
            level, message = (OK, "odometry valid") if latest.valid else (WARN, latest.reason)
        dropped = counts(worker.dropped)
        if dropped and level == OK:
            level, message = WARN, worker.overload or f"images were lost: {dropped}"
        if latest is None and dropped:
            level, message = ERROR, f"no image could be used: {dropped}"
        self._diagnostics.report(
            level,
            message,
            {
                "fitness": latest.fitness if latest else 0.0,
                "residual_m": latest.residual_m if latest else 0.0,
                "duration_ms": round(self._duration_ms, 1),
                "image_pairs": worker.input.pairs,
                "queue_length": worker.waiting,
                "dropped": dropped or "none",
                "lost": counts(worker.input.lost) or "none",
            },
        )


def main() -> None:
    """Entry point."""
    sys.exit(run(OdometryNode))


if __name__ == "__main__":
    main()
