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
from meslam_core.field import field_device, make_field
from meslam_core.frame import RgbdFrame
from meslam_core.frame_result import FrameResult, TrackingState
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.mapping.frame_training import FrameTraining
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframe_chain import KeyframeChain
from meslam_core.mapping.keyframe_policy import KeyframePolicy
from meslam_core.mapping.keyframe_registration import NewKeyframe
from meslam_core.mapping.keyframes import KeyframeStore, Rays, rays_at
from meslam_core.mapping.refinement import REFINING_STEPS, Refinement
from meslam_core.mapping.training_worker import Training
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, inverse, orthonormalized
from meslam_core.tracking.frame_history import KeyframePoses
from meslam_core.tracking.frame_tracking import FrameTracking, TrackedPose
from meslam_core.tracking.map_uncertainty import MapUncertainty
from meslam_core.tracking.pixels import TrustedPixels, trusted_pixels
from meslam_core.trajectory import Trajectory

__all__ = ["T_BODY_OPTICAL", "FrameResult", "Slam", "TrackingState"]

CURRENT_FRAME_RAYS = 4096
MIN_FRAME_PIXELS = 200


@dataclass(frozen=True)
class _Pending:
    """A tracked frame that the map has not seen yet."""

    frame: RgbdFrame
    pixels: TrustedPixels
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
        self._trains = continuation is None or continuation.train
        self.device = field_device(config.field)
        kept = config.keyframes
        self._scratch = ScratchFile(config.runtime.work_dir)
        # One network needs all its keyframes, always.
        rays_rest = None if config.regions.single else self._scratch
        self.keyframes = KeyframeStore(kept.rays, self.device, kept.ray_budget, seed, rays_rest)
        self.optimizer = JointOptimizer(self.keyframes, config.mapping, seed)
        self._chain = KeyframeChain(self.keyframes)
        self.policy = KeyframePolicy(config.keyframes, config.field)
        self.tracking = FrameTracking(config.tracking, T_map_camera, config.relocalisation)
        self._history = self.tracking.history
        self._map_uncertainty = MapUncertainty()
        self.atlas: RegionAtlas | None = None
        self._frames_wait = frames_wait
        self._seed = seed
        self._generator = np.random.default_rng(seed)
        self._T_map_first = T_map_camera
        self._training: FrameTraining | None = None
        self._refinement: Refinement | None = None
        self._pending: _Pending | None = None
        # What tracking sees of the working region while training changes the original.
        self._view: Region | None = None
        self._viewed_field = make_field(config.field, seed)
        # Keyframes that stand for an earlier session's.
        self.remembered = 0
        if continuation is not None:
            self._map_into(continuation.atlas(config, self.keyframes, seed, self._scratch))
            self.remembered = len(self.keyframes)
            self._look()
            self._map_uncertainty.update(self.keyframes)

    def begin_at(self, T_map_camera: Pose) -> None:
        """Say where the first frame is in a stored map; for who learns it after having read that.

        Args:
            T_map_camera: (4, 4), as in `Continuation`.
        """
        assert self.atlas is not None, "only a stored map has places to begin at"
        self.tracking = FrameTracking(
            self.config.tracking, T_map_camera, self.config.relocalisation
        )
        self._history = self.tracking.history
        self.atlas.take_over(
            self.atlas.grid, list(self.atlas.regions.values()), T_map_camera[:3, 3]
        )
        self._look()

    @property
    def state(self) -> TrackingState:
        """Of tracking, after the latest frame."""
        return self.tracking.state

    @property
    def wants_new_map(self) -> bool:
        """Whether the camera is lost for so long that a new map is to begin, where configured."""
        limit_s = self.config.relocalisation.new_map_after_s
        return self._trains and 0.0 < limit_s <= self.tracking.searched_s

    @property
    def recogniser(self) -> RegionRecogniser | None:
        """Asks regions that were come back to, where loops are closed."""
        return self._training.recogniser if self._training else None

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
        enough = len(pixels) >= MIN_FRAME_PIXELS
        if self._view is not None:
            rays = self._sample(frame, pixels, self.config.tracking.points) if enough else None
            witness = partial(self._recognised, frame, rays)
            tracked = self.tracking.track(frame.stamp_ns, self._view, rays, odometry, witness)
            if self.tracking.lost:
                tracked = self._sought(frame, rays, odometry) or tracked
        elif enough:
            tracked = self.tracking.start(self._T_map_first.copy())
        else:
            reason = "too few pixels with depth"
            unknown = np.eye(6)
            tracked = TrackedPose(self._T_map_first.copy(), unknown, False, reason, None)
        alignment = tracked.alignment
        result = FrameResult(
            stamp_ns=frame.stamp_ns,
            T_map_camera=tracked.T_map_camera,
            covariance=self._covariance(tracked),
            state=self.state,
            reason=tracked.reason,
            odometry=odometry,
            residual_m=alignment.residual_m if alignment else float("inf"),
            inlier_ratio=alignment.inlier_ratio if alignment else 0.0,
            tracking_ms=(time.perf_counter() - started) * 1e3,
        )
        reference, relative = 0, np.eye(4)
        if self._view is not None:
            reference = self._reference(tracked)
            relative = inverse(self._history.keyframe_pose(reference)) @ tracked.T_map_camera
        self._pending = _Pending(
            frame, pixels, tracked, result, reference, orthonormalized(relative)
        )
        return result

    def map(self) -> FrameResult:
        """Take up what training did meanwhile, and begin to train with the tracked frame."""
        assert self._pending is not None, "track a frame first"
        pending, self._pending = self._pending, None
        result, trusted = pending.result, pending.tracked.trusted
        trained = self._finish_training()
        self._chain.pass_by(result.odometry)
        if self.tracking.lost:
            self._chain.cut()
        is_keyframe = trusted and self.atlas is None
        if is_keyframe:
            self._start(pending)
            trained = self._finish_training()
        elif trusted:
            # The keyframe that the pose was found by may have moved since.
            pose = self._history.keyframe_pose(pending.reference) @ pending.T_reference_camera
            if self._trains:
                is_keyframe = self._begin_training(pending, orthonormalized(pose))
            else:
                self._follow(pose)
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
                self._history.hand_over(reference, relative)
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
        self._finish_training()

    def refine(self, steps: int, progress: float = 0.0) -> None:
        """Train on what was seen for `steps` steps, over all regions; keyframe poses follow.

        Args:
            steps: number of Adam steps.
            progress: share of the whole refinement that is done, in [0, 1]; the learning rate
                falls with it, and with it the noise that training leaves in the map.
        """
        self._finish_training()
        if self._refinement is not None:
            self._refinement.train(steps, progress)
            self._look()

    @property
    def refining_steps(self) -> int:
        """How many steps a refinement of the whole map takes."""
        if not self._trains:
            return 0
        refinement = self._refinement
        return refinement.steps if refinement else self.config.mapping.final_iterations

    def change_steps(self, mapping: MappingConfig) -> None:
        """From the next training on take the numbers of steps from another configuration."""
        changed = replace(
            self.config.mapping,
            iterations=mapping.iterations,
            min_iterations=mapping.min_iterations,
            keyframe_iterations=mapping.keyframe_iterations,
            final_iterations=mapping.final_iterations,
        )
        self.config = replace(self.config, mapping=changed)
        self.optimizer.config = changed

    def finish(self) -> None:
        """Refine once more over everything seen; then mark the observed space anew."""
        total = self.refining_steps
        for done in range(0, total, REFINING_STEPS):
            self.refine(min(REFINING_STEPS, total - done), done / total)
        self.settle()

    def settle(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        self._finish_training()
        if self._refinement is not None and self._trains:
            self._refinement.rebuild_masks()
            self._look()

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame as it is known now."""
        return self._history.trajectory()

    def known_trajectory(self) -> Trajectory:
        """`trajectory` without the frames of a lost camera, whose poses are guesses."""
        return self._history.known_trajectory()

    def online_trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it was known when the frame was done."""
        return self._history.online_trajectory()

    def _recognised(self, frame: RgbdFrame, rays: Rays | None, before: int | None) -> Pose | None:
        """Where keyframes before a number show that a frame was taken; None where they do not."""
        assert self._training is not None
        if rays is None:
            return None
        # The images of keyframes belong to the training that runs.
        self._training.settle()
        sighting = self._training.relocaliser.recognise(frame, rays, before)
        return None if sighting is None else sighting.alignment.T_map_camera

    def _sought(
        self, frame: RgbdFrame, rays: Rays | None, odometry: OdometryEstimate | None
    ) -> TrackedPose | None:
        """Look for a lost camera in the whole map; None where it is as lost as it was."""
        assert self._training is not None
        assert self.atlas is not None
        if rays is None:
            self.tracking.go_blind()
            return None
        # It looks into regions and keyframes, which belong to the training that runs.
        self._finish_training()
        refuted = self.tracking.take_refuted()
        if refuted is not None:
            self._training.relocaliser.forget(refuted)
            self.atlas.discard(refuted)
        sighting = self._training.relocaliser.find(frame, rays, self.tracking.believed)
        tracked = self.tracking.recover(frame.stamp_ns, sighting, odometry)
        if sighting is not None and tracked is not None and tracked.trusted:
            self.atlas.enter(sighting.region)
            self._look()
        return tracked

    def _reference(self, tracked: TrackedPose) -> int:
        """Number of the keyframe that a pose was found by."""
        return self._history.newest_keyframe if tracked.reference is None else tracked.reference

    def _covariance(self, tracked: TrackedPose) -> NDArray[np.float64]:
        """Covariance (6, 6) of a pose: its place in the map, and the map's own error."""
        if self._view is None:
            return tracked.covariance
        place = self._map_uncertainty.covariance(
            tracked.T_map_camera[:3, 3], self._reference(tracked)
        )
        return tracked.covariance + place

    def _sample(self, frame: RgbdFrame, pixels: TrustedPixels, count: int) -> Rays:
        return rays_at(frame, *pixels.choose(count, self._generator))

    def _finish_training(self) -> Training:
        """Wait for the training that runs, and let tracking see what it did."""
        if self._training is None:
            return Training()
        if self._training.wait():
            self._look()
            self._map_uncertainty.update(self.keyframes)
        return self._training.latest

    def _look(self) -> None:
        """Let tracking see the map as it is now; no training runs."""
        if self.atlas is None:
            return
        working = self.atlas.working
        self._viewed_field.load_flat(working.field.flat())
        mask = working.mask
        if working.unmarked:
            # Training is going to change the mask.
            mask = ObservedMask.from_flags(mask.flags.copy(), mask.voxel_m)
        self._view = working.viewed(self._viewed_field, mask)
        self._history.keyframes = KeyframePoses(self.keyframes)

    def _begin_training(self, pending: _Pending, pose: Pose) -> bool:
        """Update regions and keyframes for a tracked frame and train; whether it is a keyframe."""
        assert self.atlas is not None
        assert self._training is not None
        frame, pixels = pending.frame, pending.pixels
        self.atlas.update(pose[:3, 3])
        is_keyframe = self.policy.is_keyframe(
            self.atlas.working,
            self.keyframes,
            len(self.keyframes) - 1,
            frame.camera,
            pose,
            self._sample(frame, pixels, self.policy.PIXELS),
        )
        keyframe = self._add_keyframe(pending, pose) if is_keyframe else None
        current = self._sample(frame, pixels, CURRENT_FRAME_RAYS)
        self._look()
        self._training.start(current, pose, keyframe)
        return is_keyframe

    def _follow(self, pose: Pose) -> None:
        """Track in the region that the camera is in; nothing is trained."""
        assert self.atlas is not None
        if self.atlas.follow(pose[:3, 3]):
            self._look()

    def _start(self, pending: _Pending) -> None:
        """The first frame defines the map frame and trains the first region from nothing."""
        pose = pending.tracked.T_map_camera
        training = self._map_into(
            RegionAtlas(self.config, pose[:3, 3], self.keyframes, self._seed, self._scratch)
        )
        self._add_keyframe(pending, pose)
        training.start_first()

    def _map_into(self, atlas: RegionAtlas) -> FrameTraining:
        """From now on these regions are trained and refined."""
        self.atlas = atlas
        self._refinement = Refinement(atlas, self.optimizer)
        self._training = FrameTraining(
            self.config, atlas, self.optimizer, self._scratch, self._frames_wait
        )
        return self._training

    def _add_keyframe(self, pending: _Pending, pose: Pose) -> NewKeyframe:
        assert self.atlas is not None
        frame = pending.frame
        rays = self._sample(frame, pending.pixels, self.config.keyframes.rays)
        number = self._chain.add(frame.stamp_ns, pose, rays, pending.result.odometry)
        self.atlas.add_keyframe(number)
        return number, frame, rays
