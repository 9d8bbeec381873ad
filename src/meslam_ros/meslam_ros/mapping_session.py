"""One map in the making: the pipeline, the camera's place on the base, and what was counted."""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

from meslam_core import se3
from meslam_core.config import MappingConfig, MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.refinement import REFINING_STEPS
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.region import Region
from meslam_core.slam import FrameResult, Slam, TrackingState
from meslam_core.trajectory import Trajectory
from meslam_ros.odometry_messages import first_base_pose
from meslam_ros.transforms import CameraMount

WITH_POSE = (TrackingState.OK, TrackingState.DEGRADED)


class MappingSession:
    """From an empty map, or a stored one, to a reset.

    The map frame of a new map is where the first base was.

    Every frame takes three steps: `track`, `wait`, `map`. Training runs beside them from one `map`
    to the next `wait`; only between `wait` and `map` do the regions keep still.

    Args:
        config: of the method.
        seed: of every random choice.
        frames_wait: whether frames wait to be tracked, asked by the training thread; while they
            do and training holds them up, it gives way.
        continuation: a stored map to go on with; making the session then takes a while.

    Raises:
        MapError: when the map cannot be gone on with.

    Attributes:
        map_id: identifies the map; a stored one keeps its own.
        continuation: the stored map, if there is one.
        received, tracked: frames so far, and those with a pose.
        discarded: frames that were not processed, by reason.
        result: of the latest frame.
        mapped_ns: stamp of the newest frame that the map was trained with [ns].
    """

    def __init__(
        self,
        config: MeslamConfig,
        seed: int,
        frames_wait: Callable[[], bool] = lambda: False,
        continuation: Continuation | None = None,
    ) -> None:
        self.map_id = continuation.map_id if continuation else uuid.uuid4().hex
        self.continuation = continuation
        self.received = 0
        self.tracked = 0
        self.discarded: Counter[str] = Counter()
        self.result: FrameResult | None = None
        self.mapped_ns = 0
        self._config = config
        self._seed = seed
        self._frames_wait = frames_wait
        self._held_up = False
        self._slam: Slam | None = None
        self._mount: CameraMount | None = None
        self._start: se3.Pose | None = None
        self._refined_steps = 0
        if continuation is not None:
            self._slam = Slam(
                config, seed, frames_wait=self._must_give_way, continuation=continuation
            )

    def begin_at(self, T_map_base: se3.Pose | None) -> None:
        """Say where the base is in a stored map, (4, 4) [m]; None for where its mapping began."""
        self._start = T_map_base

    def track(
        self, frame: RgbdFrame, mount: CameraMount, odometry: OdometryEstimate | None
    ) -> FrameResult:
        """Find the pose of a frame; `map` must follow.

        Args:
            frame: the next one.
            mount: of the camera on the base.
            odometry: of the frame, where there is one.
        """
        if self._mount is None:
            self._begin(mount)
        assert self._slam is not None
        self.received += 1
        self._refined_steps = 0
        self.result = self._slam.track(frame, odometry)
        self.tracked += self.has_pose
        return self.result

    def again(self) -> MappingSession:
        """The same from its beginning; a stored map as it was stored."""
        session = MappingSession(self._config, self._seed, self._frames_wait, self.continuation)
        session.begin_at(self._start)
        return session

    def _begin(self, mount: CameraMount) -> None:
        """The first frame has come, and so it is known where the camera sits."""
        T_map_base = first_base_pose(mount) if self._start is None else self._start
        T_map_camera = T_map_base @ mount.T_base_optical
        if self._slam is None:
            self._slam = Slam(self._config, self._seed, T_map_camera, self._must_give_way)
        else:
            self._slam.begin_at(T_map_camera)
        self._mount = mount

    def change_steps(self, mapping: MappingConfig) -> None:
        """From the next training on take the numbers of steps from another configuration."""
        self._config = replace(self._config, mapping=mapping)
        if self._slam is not None:
            self._slam.change_steps(mapping)

    def wait(self) -> None:
        """Wait until the frames before are mapped; afterwards the regions keep still."""
        if self._slam is not None:
            with self._waiting():
                self._slam.wait()

    def map(self) -> FrameResult:
        """Begin to train the map with the tracked frame; all that is known of it now."""
        assert self._slam is not None
        self.wait()
        # Training on the first frame ends before `map` does; later it only begins.
        with self._waiting() if self._slam.atlas is None else nullcontext():
            self.result = self._slam.map()
        self.mapped_ns = self.result.stamp_ns
        return self.result

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        self._held_up = True
        try:
            yield
        finally:
            self._held_up = False

    def _must_give_way(self) -> bool:
        """Whether training holds up frames that wait.

        A frame that waits while tracking is at work, or is only just being handed over, waits for
        something else: then training may as well go on. So a recording that is played in lockstep
        is mapped the same however slow the computer is.
        """
        return self._held_up and self._frames_wait()

    def refine(self) -> bool:
        """Refine the map for a moment while no image comes; False when that is done."""
        total = self._slam.refining_steps if self._slam else 0
        if self._slam is None or self._refined_steps >= total:
            return False
        self._slam.refine(REFINING_STEPS, self._refined_steps / total)
        self._refined_steps += REFINING_STEPS
        if self._refined_steps >= total:
            self._slam.settle()
        return True

    @property
    def has_pose(self) -> bool:
        """Whether the latest frame has a pose that is worth publishing."""
        return self.result is not None and self.result.state in WITH_POSE

    @property
    def localises(self) -> bool:
        """Whether the map is left as it is."""
        return self.continuation is not None and not self.continuation.train

    @property
    def T_map_base(self) -> se3.Pose | None:
        """Pose (4, 4) of the base at the latest frame [m]; None where that has none."""
        if self.result is None or not self.has_pose:
            return None
        return self.result.T_map_camera @ self.T_camera_base

    @property
    def T_camera_base(self) -> se3.Pose:
        """Where the base is in the camera's frame, (4, 4) [m]."""
        assert self._mount is not None
        return se3.inverse(self._mount.T_base_optical)

    @property
    def regions(self) -> Collection[Region]:
        """All regions; empty before the first frame with depth."""
        atlas = self._slam.atlas if self._slam else None
        return list(atlas.regions.values()) if atlas else []

    @property
    def working_region(self) -> RegionIndex:
        """Lattice index of the region that is optimised with the pose."""
        atlas = self._slam.atlas if self._slam else None
        return atlas.working.index if atlas else (0, 0, 0)

    @property
    def training_regions(self) -> list[RegionIndex]:
        """Lattice indices of the regions that are trained without influence on the pose."""
        atlas = self._slam.atlas if self._slam else None
        return [region.index for region in atlas.training] if atlas else []

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self._slam.keyframes) if self._slam else 0

    def trajectory(self) -> Trajectory:
        """T_map_camera of all frames as it is known now, but of those of a lost camera."""
        assert self._slam is not None
        return self._slam.known_trajectory()

    @property
    def wants_new_map(self) -> bool:
        """Whether the camera is lost for so long that a new map is to begin, where configured."""
        return self._slam is not None and self._slam.wants_new_map
