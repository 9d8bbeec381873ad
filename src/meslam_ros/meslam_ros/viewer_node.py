"""`viewer_node`: a page in the browser that shows the map while it grows."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from meslam_core.errors import FrameError, MapError
from meslam_core.se3 import Pose
from meslam_core.viewer.camera_image import reduced
from meslam_core.viewer.scene import ViewControls
from meslam_core.viewer.viewer import Viewer
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import color_image
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, OK, STALE, Diagnostics
from meslam_ros.live_scene import LiveScene
from meslam_ros.looked_up import LookedUpTopic
from meslam_ros.managed_node import ManagedNode, run
from meslam_ros.node_settings import FrameSettings
from meslam_ros.parameters import declare_settings
from meslam_ros.qos import MODELS_DEPTH, STREAM, images, latched
from meslam_ros.rgbd_input import STEADY
from meslam_ros.transforms import BaseFrame, StaticTransforms
from meslam_ros.viewer_settings import ViewerSettings

T = TypeVar("T")

NICENESS = 10
CAMERA_PERIOD_S = 0.07
IMAGE_PERIOD_S = 0.2
PATH_PERIOD_S = 1.0
# Nobody waits for a viewer: lost images are not sent again.
BEST_EFFORT = images(ReliabilityPolicy.BEST_EFFORT, 1)


class ViewerNode(ManagedNode):
    """Listens to tracking and shows it; what takes time is done only while somebody looks."""

    def __init__(self, **options: Any) -> None:
        super().__init__("viewer_node", **options)
        self._frames = declare_settings(self, FrameSettings)
        self._settings = declare_settings(self, ViewerSettings)

    def configure(self) -> None:
        settings = self._settings
        controls = ViewControls(mesh_resolution_m=settings.mesh_resolution_m)
        self._viewer = Viewer(settings.host, settings.port, controls)
        self._transforms = StaticTransforms(self)
        self._base = BaseFrame(
            self._transforms,
            self._frames.base_frame,
            self._frames.transform_timeout_s,
            self.get_logger().warn,
        )
        self._live = LiveScene(self._viewer.scene, self._viewer.map, self._T_base_camera)
        self._diagnostics = Diagnostics(self)
        self.get_logger().info(f"the map is shown on {self._viewer.page.url}")

    def activate(self) -> None:
        self._models = self.create_subscription(
            RegionModel, topics.REGION_MODELS, self._take_model, latched(MODELS_DEPTH)
        )
        self._status = LookedUpTopic(self, TrackingStatus, topics.STATUS, STREAM)
        self._pose = LookedUpTopic(self, PoseStamped, topics.POSE, STREAM)
        self._info = LookedUpTopic(self, CameraInfo, topics.COLOR_INFO, BEST_EFFORT)
        self._watched: tuple[LookedUpTopic, LookedUpTopic] | None = None
        self._clocks = [
            self.create_timer(CAMERA_PERIOD_S, self._show_camera, clock=STEADY),
            self.create_timer(IMAGE_PERIOD_S, self._show_image, clock=STEADY),
            self.create_timer(PATH_PERIOD_S, self._show_path, clock=STEADY),
            self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY),
        ]

    def deactivate(self) -> None:
        for timer in self._clocks:
            self.destroy_timer(timer)
        self.destroy_subscription(self._models)
        for topic in (self._status, self._pose, self._info, *(self._watched or ())):
            topic.close()

    def cleanup(self) -> None:
        self._diagnostics.close()
        self._transforms.close()
        self._viewer.close()

    def _follow_viewers(self) -> None:
        """Subscribe to what is large while somebody looks.

        Not before tracking has begun: a player waits until so many listen, and means others.
        """
        wanted = self._viewer.page.viewers > 0 and self._live.begun
        if wanted and self._watched is None:
            self._watched = (
                LookedUpTopic(self, Image, topics.COLOR, BEST_EFFORT),
                LookedUpTopic(self, Path, topics.PATH, latched()),
            )
        elif not wanted and self._watched is not None:
            for topic in self._watched:
                topic.close()
            self._watched = None

    def _show_camera(self) -> None:
        for status in self._status.news():
            self._live.take_status(status)
        for pose in self._pose.news():
            self._take(self._live.take_pose, pose)

    def _show_image(self) -> None:
        self._follow_viewers()
        if (info := self._info.newest()) is not None:
            self._take(self._live.take_info, info)
        if self._watched is None or (message := self._watched[0].newest()) is None:
            return
        try:
            image = color_image(message, topics.COLOR)
        except FrameError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        self._viewer.scene.image.set(reduced(image))

    def _show_path(self) -> None:
        self._live.notice_silence()
        if self._watched is not None and (path := self._watched[1].newest()) is not None:
            self._take(self._live.take_path, path)

    def _take_model(self, model: RegionModel) -> None:
        self._take(self._live.take_model, model)

    def _take(self, take: Callable[[T], None], message: T) -> None:
        """Take a message that may hold anything; what cannot be shown is told."""
        try:
            take(message)
        except (FrameError, MapError) as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _T_base_camera(self, camera_frame: str) -> Pose | None:
        mount = self._base.resolve(camera_frame)
        return None if mount is None else mount.T_base_optical

    def _diagnose(self) -> None:
        viewers, regions = self._viewer.page.viewers, self._live.regions
        self._diagnostics.report(
            OK if self._live.begun else STALE,
            f"{viewers} watching" if self._live.begun else "nothing is tracked yet",
            {"url": self._viewer.page.url, "viewers": viewers, "regions": regions},
        )


def main() -> None:
    """Entry point."""
    # Before there are threads: each has a niceness of its own.
    os.nice(NICENESS)
    sys.exit(run(ViewerNode))


if __name__ == "__main__":
    main()
