"""The pipeline: odometry gives a first guess, tracking refines it, joint optimisation maps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.config import MappingConfig, MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.frame import RgbdFrame
from meslam_core.frame_result import FrameResult, TrackingState
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.mapper import Mapper, SampledFrame
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, orthonormalized
from meslam_core.tracking.depth_plausibility import is_stuck, unusable_depth, warn_of_depth
from meslam_core.tracking.frame_history import KeyframePoses
from meslam_core.tracking.frame_tracking import FrameTracking, TrackedPose
from meslam_core.tracking.pixels import TrustedPixels, trusted_pixels
from meslam_core.trajectory import Trajectory

__all__ = ["T_BODY_OPTICAL", "FrameResult", "Slam", "TrackingState"]

MIN_FRAME_PIXELS = 200


@dataclass(frozen=True)
class _Pending:
    """A tracked frame that the map has not seen yet."""

    sampled: SampledFrame
    tracked: TrackedPose
    result: FrameResult
    reference: int
    T_reference_camera: Pose


class Slam:
    """Tracks frames and maps what they see.

    Frames come in the order of their stamps; one object serves one continuous recording, from one
    thread. Training runs in a thread of its own, beside the tracking of the next frame: tracking
    sees the weights and keyframe poses as they were when training began. That is the same for
    every run, however fast the two threads are.

    Args:
        config: all numbers.
        seed: of every random choice; the same frames and seed give the same result.
        T_map_camera: (4, 4) pose of the first frame; by default the first camera defines the
            map frame, x forward and z up.
        frames_wait: whether frames wait to be tracked. While they do, mapping gives way: it ends
            after `mapping.min_iterations` steps. A live system asks its queue; by default nothing
            waits, and every frame gets all its steps.
        continuation: a stored map to go on with, instead of an empty one; it tells where the
            first frame is, and whether the map is trained further.

    Raises:
        MapError: when the map cannot be continued.
    """

    def __init__(
        self,
        config: MeslamConfig,
        seed: int = 0,
        T_map_camera: Pose = T_BODY_OPTICAL,
        frames_wait: Callable[[], bool] = lambda: False,
        continuation: Continuation | None = None,
    ) -> None:
        if continuation is not None:
            config = continuation.adapted(config)
            T_map_camera = continuation.T_map_camera
        self.config = config
        self.tracking = FrameTracking(config.tracking, T_map_camera, config.relocalisation)
        self._history = self.tracking.history
        self._generator = np.random.default_rng(seed)
        self._T_map_first = T_map_camera
        self._pending: _Pending | None = None
        # What tracking sees of the working region.
        self._view: Region | None = None
        self._mapper = Mapper(config, seed, frames_wait, self._see, continuation)
        self._mapper.look()

    def begin_at(self, T_map_camera: Pose) -> None:
        """Say where the first frame is in a stored map; for who learns it after having read that.

        Args:
            T_map_camera: (4, 4), as in `Continuation`.
        """
        self.tracking = FrameTracking(
            self.config.tracking, T_map_camera, self.config.relocalisation
        )
        self._history = self.tracking.history
        self._mapper.begin_at(T_map_camera[:3, 3])

    @property
    def atlas(self) -> RegionAtlas | None:
        """The regions; None before the first frame."""
        return self._mapper.atlas

    @property
    def keyframes(self) -> KeyframeStore:
        """Of all regions."""
        return self._mapper.keyframes

    @property
    def optimizer(self) -> JointOptimizer:
        """Trains regions and keyframes' poses."""
        return self._mapper.optimizer

    @property
    def remembered(self) -> int:
        """How many keyframes stand for an earlier session's."""
        return self._mapper.remembered

    @property
    def state(self) -> TrackingState:
        """Of tracking, after the latest frame."""
        return self.tracking.state

    @property
    def working_view(self) -> Region | None:
        """The working region as tracking sees it, which training leaves alone."""
        return self._view

    @property
    def wants_new_map(self) -> bool:
        """Whether the camera is lost for so long that a new map is to begin, where configured."""
        limit_s = self.config.relocalisation.new_map_after_s
        return self._mapper.trains and 0.0 < limit_s <= self.tracking.searched_s

    @property
    def recogniser(self) -> RegionRecogniser | None:
        """Asks regions that were come back to, where loops are closed."""
        return self._mapper.recogniser

    def process(self, frame: RgbdFrame, odometry: OdometryEstimate | None = None) -> FrameResult:
        """Track one frame and begin to train the map with it.

        Args:
            frame: the next image pair.
            odometry: its external odometry; without one, the last motion is continued.
        """
        self.track(frame, odometry)
        return self.map()

    def track(self, frame: RgbdFrame, odometry: OdometryEstimate | None = None) -> FrameResult:
        """Find the pose of the next frame; `map` must follow.

        Args:
            frame: the next image pair.
            odometry: its external odometry; without one, the last motion is continued.
        """
        started = time.perf_counter()
        pixels = TrustedPixels(trusted_pixels(frame.depth_m, self.config.sensor))
        sampled = SampledFrame(frame, pixels, self._generator)
        enough = len(pixels) >= MIN_FRAME_PIXELS and not is_stuck(frame.depth_m)
        doubt = "" if enough else unusable_depth(frame.depth_m, self.config.sensor)
        if self._view is not None:
            rays = sampled.rays(self.config.tracking.points) if enough else None
            witness = partial(self._recognised, frame, rays)
            attest = partial(self._attested, frame)
            tracked = self.tracking.track(
                frame.stamp_ns, self._view, rays, odometry, witness, attest
            )
            if self.tracking.lost:
                tracked = self._sought(frame, rays, odometry) or tracked
        elif enough:
            warn_of_depth(frame.depth_m)
            tracked = self.tracking.start(self._T_map_first.copy())
        else:
            unknown = np.eye(6)
            tracked = TrackedPose(self._T_map_first.copy(), unknown, False, doubt, None)
        alignment = tracked.alignment
        result = FrameResult(
            stamp_ns=frame.stamp_ns,
            T_map_camera=tracked.T_map_camera,
            covariance=self._covariance(tracked),
            state=self.state,
            reason=doubt or tracked.reason,
            odometry=odometry,
            residual_m=alignment.residual_m if alignment else float("inf"),
            inlier_ratio=alignment.inlier_ratio if alignment else 0.0,
            tracking_ms=(time.perf_counter() - started) * 1e3,
        )
        reference, relative = 0, np.eye(4)
        if self._view is not None:
            reference = self._reference(tracked)
            relative = inverse(self._history.keyframe_pose(reference)) @ tracked.T_map_camera
        self._pending = _Pending(sampled, tracked, result, reference, orthonormalized(relative))
        return result

    def map(self) -> FrameResult:
        """Take up what training did meanwhile, and begin to train with the tracked frame."""
        assert self._pending is not None, "track a frame first"
        pending, self._pending = self._pending, None
        result, trusted = pending.result, pending.tracked.trusted
        trained = self._mapper.wait()
        self._mapper.pass_by(result.odometry, self.tracking.lost)
        is_keyframe = trusted and self.atlas is None
        if is_keyframe:
            self._mapper.begin(pending.sampled, pending.tracked.T_map_camera, result.odometry)
            trained = self._mapper.wait()
        elif trusted:
            # The keyframe that the pose was found by may have moved since.
            pose = self._history.keyframe_pose(pending.reference) @ pending.T_reference_camera
            is_keyframe = self._mapper.train(
                pending.sampled,
                orthonormalized(pose),
                result.odometry,
                lags=result.state is not TrackingState.OK,
            )
        if self.atlas is not None:
            self._remember(pending, is_keyframe)
        return replace(
            result,
            is_keyframe=is_keyframe,
            losses=trained.losses,
            mapping_ms=trained.duration_ms,
        )

    def _remember(self, pending: _Pending, is_keyframe: bool) -> None:
        reference, relative = pending.reference, pending.T_reference_camera
        if is_keyframe:
            if len(self._history):
                self._history.hand_over(relative)
            reference, relative = len(self.keyframes) - 1, np.eye(4)
        result = pending.result
        self._history.add(
            result.stamp_ns,
            result.T_map_camera,
            reference,
            relative,
            result.odometry,
            known=not self.tracking.lost,
        )

    def wait(self) -> None:
        """Wait until the latest frame is mapped."""
        self._mapper.wait()

    def refine(self, steps: int, progress: float = 0.0) -> None:
        """Train on what was seen for `steps` steps; see `Mapper.refine`."""
        self._mapper.refine(steps, progress)

    @property
    def refining_steps(self) -> int:
        """How many steps a refinement of the whole map takes."""
        return self._mapper.refining_steps

    def change_steps(self, mapping: MappingConfig) -> None:
        """From the next training on take the numbers of steps from another configuration."""
        self._mapper.change_steps(mapping)

    def finish(self, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Refine once more over everything seen; then mark the observed space anew.

        Args:
            progress: called with the steps that are done and their total.
        """
        self._mapper.finish(progress)

    def settle(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        self._mapper.settle()

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame as it is known now."""
        return self._history.trajectory()

    def known_trajectory(self) -> Trajectory:
        """`trajectory` without the frames of a lost camera, whose poses are guesses."""
        return self._history.known_trajectory()

    def online_trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it was known when the frame was done."""
        return self._history.online_trajectory()

    def _see(self, view: Region) -> None:
        """From now on track in this view of the map."""
        self._view = view
        self._history.keyframes = KeyframePoses(self.keyframes)

    def _recognised(self, frame: RgbdFrame, rays: Rays | None, before: int | None) -> Pose | None:
        """Where keyframes before a number show that a frame was taken; None where they do not."""
        if rays is None:
            return None
        # The images of keyframes belong to the training that runs.
        self._mapper.pause()
        sighting = self._mapper.relocaliser.recognise(frame, rays, before)
        return None if sighting is None else sighting.alignment.T_map_camera

    def _attested(self, frame: RgbdFrame, T_map_camera: Pose) -> bool:
        """Whether the keyframe of late shows that a frame was taken at a pose."""
        self._mapper.pause()
        return self._mapper.relocaliser.attests(frame, self._mapper.reference, T_map_camera)

    def _sought(
        self, frame: RgbdFrame, rays: Rays | None, odometry: OdometryEstimate | None
    ) -> TrackedPose | None:
        """Look for a lost camera in the whole map; None where it is as lost as it was."""
        if rays is None:
            self.tracking.go_blind()
            return None
        # It looks into regions and keyframes, which belong to the training that runs.
        self._mapper.wait()
        refuted = self.tracking.take_refuted()
        if refuted is not None:
            self._mapper.discard(refuted)
        sighting = self._mapper.relocaliser.find(frame, rays, self.tracking.believed)
        tracked = self.tracking.recover(frame.stamp_ns, sighting, odometry)
        if sighting is not None and tracked is not None and tracked.trusted:
            self._mapper.enter(sighting.region)
        return tracked

    def _reference(self, tracked: TrackedPose) -> int:
        """Number of the keyframe that a pose was found by."""
        return self._mapper.reference if tracked.reference is None else tracked.reference

    def _covariance(self, tracked: TrackedPose) -> NDArray[np.float64]:
        """Covariance (6, 6) of a pose: its place in the map, and the map's own error."""
        if self._view is None:
            return tracked.covariance
        place = self._mapper.covariance(tracked.T_map_camera, self._reference(tracked))
        return tracked.covariance + place
