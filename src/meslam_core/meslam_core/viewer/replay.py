"""A finished run in the viewer: its map, and a time that can be walked along."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np

from meslam_core.map.reader import LoadedMap
from meslam_core.regions.observed_mask import OBSERVED
from meslam_core.report.run_folder import RunFolder
from meslam_core.se3 import Pose
from meslam_core.trajectory import NANOSECONDS, Trajectory
from meslam_core.viewer.page import Page
from meslam_core.viewer.panel import TIMELINE_ORDER, within
from meslam_core.viewer.run_images import RunImages
from meslam_core.viewer.scene import RegionBox, RegionState, Scene, Status, camera_view

TICK_S = 0.05
SPEEDS = ("0.5", "1", "2", "5", "10")


def region_boxes(loaded: LoadedMap) -> tuple[RegionBox, ...]:
    """The regions of a stored map."""
    return tuple(
        RegionBox(
            region.index,
            region.T_map_region,
            region.side_m,
            len(loaded.encoded[region.index]),
            region.keyframes,
        )
        for region in loaded.regions
    )


def map_status(loaded: LoadedMap) -> Status:
    """What a stored map says about itself."""
    volumes = (
        np.count_nonzero(region.mask.flags & OBSERVED) * region.mask.voxel_m**3
        for region in loaded.regions
    )
    return Status(
        state="STORED",
        map_bytes=sum(map(len, loaded.encoded.values())),
        observed_volume_m3=float(sum(volumes)),
        keyframes=sum(region.keyframes for region in loaded.regions),
    )


def run_status(run: RunFolder, status: Status) -> Status:
    """A map's status with what the run's report adds."""
    entries = run.entries
    volume = entries.get("observed_volume_m3")
    return replace(
        status,
        state="FINISHED",
        frames_per_s=entries.get("fps"),
        frames_tracked=entries.get("frames_tracked"),
        keyframes=entries.get("keyframes", status.keyframes),
        observed_volume_m3=volume or status.observed_volume_m3,
    )


class Replay:
    """Sets the scene to how the run was at a time; the page's panel gets the controls.

    Args:
        scene: holds the map.
        page: gets a timeline.
        run: with a refined trajectory.
    """

    def __init__(self, scene: Scene, page: Page, run: RunFolder) -> None:
        assert run.refined is not None
        self._scene = scene
        self._run = run
        self._refined: Trajectory = run.refined
        self._online = run.online if run.online is not None else run.refined
        self._status = scene.status.value
        self._images = (
            RunImages(run.recording, scene.image.set) if run.recording is not None else None
        )
        scene.refined_path.set(self._refined.positions)
        with page.gui.add_folder("Replay", order=TIMELINE_ORDER):
            self._slider = page.gui.add_slider("Time [s]", 0.0, self._duration_s, 0.01, 0.0)
            self._playing = page.gui.add_checkbox("Play", False)
            self._speed = page.gui.add_dropdown("Speed", SPEEDS, initial_value="1")
        self._slider.on_update(self._take_time)
        self.show(0.0)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._play, name="viewer replay", daemon=True)
        self._thread.start()

    @property
    def _duration_s(self) -> float:
        return max(round(self._refined.duration_s, 2), TICK_S)

    def close(self) -> None:
        """Stop."""
        self._stopping.set()
        self._thread.join()
        if self._images is not None:
            self._images.close()

    def _take_time(self, _: object) -> None:
        time_s = within(self._slider.value, (0.0, self._duration_s))
        if time_s is not None:
            self.show(time_s)

    def show(self, time_s: float) -> None:
        """Show a time since the first pose [s]."""
        stamps_ns = self._refined.stamps_ns
        now_ns = int(stamps_ns[0]) + round(time_s * NANOSECONDS)
        number = max(0, int(np.searchsorted(stamps_ns, now_ns, "right")) - 1)
        T_map_camera = self._refined.poses[number]
        self._scene.camera.set(camera_view(T_map_camera, self._run.camera))
        passed = int(np.searchsorted(self._online.stamps_ns, now_ns, "right"))
        self._scene.online_path.set(self._online.positions[:passed])
        self._mark_region(T_map_camera)
        self._tell(int(stamps_ns[number]))
        if self._images is not None:
            self._images.seek(int(stamps_ns[number]))

    def _mark_region(self, T_map_camera: Pose) -> None:
        """The region whose centre is nearest is the one that worked."""
        boxes = self._scene.regions.value
        if not boxes:
            return
        away = [np.linalg.norm(box.T_map_region[:3, 3] - T_map_camera[:3, 3]) for box in boxes]
        working = int(np.argmin(away))
        states = [
            RegionState.WORKING if number == working else RegionState.AT_REST
            for number in range(len(boxes))
        ]
        if [box.state for box in boxes] != states:
            self._scene.regions.set(
                tuple(replace(b, state=s) for b, s in zip(boxes, states, strict=True))
            )

    def _tell(self, stamp_ns: int) -> None:
        """The state of tracking then, where the run has recorded it."""
        frames = self._run.frames
        if frames is None:
            return
        number = min(int(np.searchsorted(frames.stamps_ns, stamp_ns)), len(frames) - 1)
        state, reason = frames.states[number], frames.reasons[number]
        self._scene.status.set(replace(self._status, state=state, reason=reason))

    def _play(self) -> None:
        before = time.monotonic()
        while not self._stopping.wait(TICK_S):
            now = time.monotonic()
            passed_s, before = now - before, now
            speed, time_s = self._speed.value, within(self._slider.value, (0.0, self._duration_s))
            if self._playing.value is not True or speed not in SPEEDS or time_s is None:
                continue
            time_s = min(time_s + passed_s * float(speed), self._duration_s)
            # Setting the slider shows that time too.
            self._slider.value = round(time_s, 2)  # type: ignore[misc]  # it has a setter
            if time_s == self._duration_s:
                self._playing.value = False  # type: ignore[misc]
