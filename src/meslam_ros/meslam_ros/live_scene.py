"""A running system's messages as the viewer's scene."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.viewer.background_map import BackgroundMap
from meslam_core.viewer.scene import RegionBox, RegionState, Scene, Status, camera_view
from meslam_interfaces.msg import Region, RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import camera_from_info, from_pose
from meslam_ros.region_catalog import RegionCatalog, RegionEntry, check_payload, region_index

REGION_STATES = {
    Region.AT_REST: RegionState.AT_REST,
    Region.TRAINING: RegionState.TRAINING,
    Region.WORKING: RegionState.WORKING,
}
STATE_NAMES = {
    TrackingStatus.INITIALISING: "INITIALISING",
    TrackingStatus.OK: "OK",
    TrackingStatus.DEGRADED: "DEGRADED",
    TrackingStatus.LOST: "LOST",
    TrackingStatus.RELOCALISING: "RELOCALISING",
}
RATE_WINDOW_S = 3.0
SILENCE_S = 3.0
# Positions of the path that are nearer to each other look the same.
STEP_M = 0.005
# Axes of an optical frame (x right, y down, z ahead) in those of a body (x ahead, z up).
T_BODY_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class LiveScene:
    """Takes what tracking publishes; all from one thread.

    Args:
        scene: that is shown.
        background: makes meshes of the regions' models.
        mount: tells T_base_camera (4, 4) [m] of a camera's frame; None as long as it is not known.
    """

    def __init__(
        self,
        scene: Scene,
        background: BackgroundMap,
        mount: Callable[[str], se3.Pose | None],
    ) -> None:
        self._scene = scene
        self._background = background
        self._mount = mount
        self._catalog = RegionCatalog()
        self._live_map_id = ""
        self._camera: PinholeCamera | None = None
        self._camera_frame = ""
        self._path = np.empty((1, 3))
        self._passed = 0
        self._arrivals: deque[float] = deque()
        self._heard_s: float | None = None
        scene.status.set(
            Status(
                reason=f"waits for {topics.STATUS}: is slam_node running, with the same "
                "ROS_DOMAIN_ID?"
            )
        )

    @property
    def begun(self) -> bool:
        """Whether tracking has said something."""
        return self._heard_s is not None

    @property
    def regions(self) -> int:
        """Number of regions shown."""
        return len(self._catalog.entries)

    def take_info(self, info: CameraInfo) -> None:
        """Take the camera's intrinsics and frame.

        Raises:
            FrameError: when there are no intrinsics in it.
        """
        self._camera = camera_from_info(info, topics.COLOR_INFO)
        self._camera_frame = info.header.frame_id

    def take_pose(self, message: PoseStamped) -> None:
        """Take the base's pose of a frame.

        Raises:
            FrameError: when it is none.
        """
        T_map_camera = from_pose(message.pose) @ self._T_base_camera()
        self._scene.camera.set(camera_view(T_map_camera, self._camera))
        position = T_map_camera[:3, 3]
        if not self._passed or np.linalg.norm(position - self._path[self._passed - 1]) > STEP_M:
            self._extend_path(position)

    def take_path(self, message: Path) -> None:
        """Take the refined path.

        Raises:
            FrameError: when a pose of it is none.
        """
        if not message.poses:
            self._scene.refined_path.set(np.zeros((0, 3)))
            return
        poses = np.array([from_pose(stamped.pose) for stamped in message.poses])
        self._scene.refined_path.set((poses @ self._T_base_camera())[:, :3, 3])

    def take_model(self, model: RegionModel) -> None:
        """Take a region's network, unless it is of a map before, or not news.

        Raises:
            MapError: when the model is damaged or its header cannot be that of a region.
        """
        if self._live_map_id not in ("", model.map_id) or not self._catalog.is_news(model):
            return
        check_payload(model)
        entry = RegionEntry.of(model)
        if model.map_id != self._catalog.map_id:
            self._begin(model.map_id)
        self._catalog.add(entry)
        self._background.take(entry.index, entry.version, bytes(model.data))
        self._show_regions()
        self._scene.status.set(replace(self._scene.status.value, **self._map_size()))

    def take_status(self, message: TrackingStatus) -> None:
        """Take how tracking is doing."""
        now = time.monotonic()
        self._heard_s = now
        self._live_map_id = message.map_id
        if message.map_id != self._catalog.map_id:
            self._begin(message.map_id)
        if not message.settled:
            self._arrivals.append(now)
        while self._arrivals and now - self._arrivals[0] > RATE_WINDOW_S:
            self._arrivals.popleft()
        training = {region_index(entry.index) for entry in message.training_regions}
        if self._catalog.set_active(region_index(message.working_region), training):
            self._show_regions()
        state = "PAUSED" if message.paused else STATE_NAMES.get(message.state, "")
        self._scene.status.set(
            Status(
                state=state,
                reason=message.reason,
                frames_per_s=self._rate(),
                frames_tracked=message.frames_tracked,
                frames_dropped=message.frames_dropped,
                latency_ms=1000.0 * message.latency_s,
                keyframes=message.keyframes,
                **self._map_size(),
            )
        )

    def notice_silence(self) -> None:
        """Say so when nothing comes any more; to be called now and then."""
        if self._heard_s is None:
            return
        silence_s = time.monotonic() - self._heard_s
        if silence_s > SILENCE_S:
            status = self._scene.status.value
            reason = f"no image pair has been tracked for {silence_s:.0f} s"
            self._scene.status.set(replace(status, frames_per_s=0.0, reason=reason))

    def _begin(self, map_id: str) -> None:
        """Another map: what is known of the one before is forgotten."""
        self._catalog.begin(map_id)
        self._background.begin()
        self._path, self._passed = np.empty((1, 3)), 0
        self._scene.online_path.set(np.zeros((0, 3)))
        self._scene.refined_path.set(np.zeros((0, 3)))
        self._show_regions()

    def _extend_path(self, position: NDArray[np.float64]) -> None:
        """One more position of the path, which is never copied but when its room is used up."""
        if self._passed == len(self._path):
            self._path = np.concatenate([self._path, np.empty_like(self._path)])
        self._path[self._passed] = position
        self._passed += 1
        self._scene.online_path.set(self._path[: self._passed])

    def _T_base_camera(self) -> se3.Pose:
        known = self._mount(self._camera_frame) if self._camera_frame else None
        return T_BODY_OPTICAL if known is None else known

    def _rate(self) -> float | None:
        """Frames a second of the last moments."""
        if len(self._arrivals) < 2:
            return None
        return (len(self._arrivals) - 1) / (self._arrivals[-1] - self._arrivals[0])

    def _map_size(self) -> dict[str, float]:
        entries = self._catalog.entries.values()
        return {
            "map_bytes": sum(entry.size for entry in entries),
            "observed_volume_m3": sum(entry.observed_volume_m3 for entry in entries),
        }

    def _show_regions(self) -> None:
        self._scene.regions.set(
            tuple(
                RegionBox(
                    entry.index,
                    from_pose(entry.pose),
                    entry.side_m,
                    entry.size,
                    entry.keyframes,
                    REGION_STATES[entry.state],
                )
                for entry in self._catalog.entries.values()
            )
        )
