"""The pipeline: odometry gives a first guess, tracking refines it, joint optimisation maps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from meslam_core.config import MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.field import field_device, make_field
from meslam_core.frame import RgbdFrame
from meslam_core.frame_result import FrameResult, TrackingState
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframe_policy import KeyframePolicy
from meslam_core.mapping.keyframes import KeyframeStore, Rays, rays_at
from meslam_core.mapping.training_worker import Training, TrainingWorker
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, inverse, orthonormalized
from meslam_core.tracking.frame_history import KeyframePoses
from meslam_core.tracking.frame_tracking import FrameTracking, TrackedPose
from meslam_core.tracking.pixels import TrustedPixels, trusted_pixels
from meslam_core.trajectory import Trajectory

__all__ = ["FrameResult", "Slam", "TrackingState"]

# The first camera looks along the map's x axis and z points up (REP-103).
T_BODY_OPTICAL: Pose = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
CURRENT_FRAME_RAYS = 4096
MIN_FRAME_PIXELS = 200
# Of the first frame's steps so many come before the next frame may be tracked; the following
# frames make up for the rest, so many steps each.
FIRST_STEPS_SHARE = 0.4
MADE_UP_A_FRAME = 40
# Odometry ties a keyframe to the one before; a registration of the two says it better.
ODOMETRY_LINK_WEIGHT = 0.05
# A refinement comes in portions of so many steps, the last at this share of the learning rate.
REFINING_STEPS = 50
# Of several regions each is refined so long before it is the next one's turn, on average.
TURN_STEPS = 400
LAST_RATE_FACTOR = 0.05


@dataclass(frozen=True)
class _Pending:
    """A tracked frame that the map has not seen yet."""

    frame: RgbdFrame
    pixels: TrustedPixels
    tracked: TrackedPose
    result: FrameResult
    reference: int
    T_reference_camera: Pose


@dataclass
class _Refinement:
    """Whose turn it is.

    Attributes:
        region: number of the region that is refined, in the order of their creation.
        left: steps that it still gets in this turn.
    """

    region: int = -1
    left: int = 0


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
            first frame is.

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
        self.device = field_device(config.field)
        kept = config.keyframes
        self._scratch = ScratchFile(config.runtime.work_dir)
        # One network needs all its keyframes, always.
        rays_rest = None if config.regions.single else self._scratch
        self.keyframes = KeyframeStore(kept.rays, self.device, kept.ray_budget, seed, rays_rest)
        self.optimizer = JointOptimizer(self.keyframes, config.mapping, seed)
        self.policy = KeyframePolicy(config.keyframes, config.field)
        self.tracking = FrameTracking(config.tracking, T_map_camera)
        self._history = self.tracking.history
        self.atlas: RegionAtlas | None = None
        self._frames_wait = frames_wait
        self._seed = seed
        self._generator = np.random.default_rng(seed)
        self._T_map_first = T_map_camera
        self._worker = TrainingWorker()
        self._linker: CovisibilityLinker | None = None
        if config.keyframes.links:
            self._linker = CovisibilityLinker(self.keyframes, config, self._scratch)
        self.recogniser: RegionRecogniser | None = None
        self._trained: list[Region] = []
        self._latest_training = Training()
        self._steps_owed = 0
        self._turn = 0
        self._refined = _Refinement()
        self._pending: _Pending | None = None
        self._keyframe_odometry: OdometryEstimate | None = None
        # What tracking sees of the working region while training changes the original.
        self._view: Region | None = None
        self._viewed_field = make_field(config.field, seed)
        # Keyframes that stand for an earlier session's.
        self.remembered = 0
        if continuation is not None:
            self.atlas = continuation.atlas(config, self.keyframes, seed, self._scratch)
            self.remembered = len(self.keyframes)
            self._look()

    @property
    def state(self) -> TrackingState:
        """Of tracking, after the latest frame."""
        return self.tracking.state

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
            tracked = self.tracking.track(frame.stamp_ns, self._view, rays, odometry)
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
            covariance=tracked.covariance,
            state=self.state,
            reason=tracked.reason,
            odometry=odometry,
            residual_m=alignment.residual_m if alignment else float("inf"),
            inlier_ratio=alignment.inlier_ratio if alignment else 0.0,
            tracking_ms=(time.perf_counter() - started) * 1e3,
        )
        reference, relative = 0, np.eye(4)
        if self._view is not None:
            reference = self._history.newest_keyframe
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
        if result.odometry is not None and not result.odometry.valid:
            self._keyframe_odometry = None
        is_keyframe = trusted and self.atlas is None
        if is_keyframe:
            self._start(pending)
            trained = self._finish_training()
        elif trusted:
            # The keyframe that the pose was found by may have moved since.
            pose = self._history.keyframe_pose(pending.reference) @ pending.T_reference_camera
            is_keyframe = self._begin_training(pending, orthonormalized(pose))
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
            result.stamp_ns, result.T_map_camera, reference, relative, result.odometry
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
        if self.atlas is None or not self._touched:
            return
        rate_factor = 1.0 + progress * (LAST_RATE_FACTOR - 1.0)
        while steps > 0:
            region, portion = self._next_to_refine(steps)
            with self.atlas.awake(region):
                self.optimizer.train(region, portion, rate_factor=rate_factor)
            region.version += 1
            steps -= portion
        self._look()

    @property
    def refining_steps(self) -> int:
        """How many steps a refinement of the whole map takes.

        More than of a single region, but not in proportion: each of many was shorter in view, and
        its neighbours refine the same keyframes.
        """
        regions = len(self._touched) if self.atlas else 0
        return round(self.config.mapping.final_iterations * math.sqrt(max(regions, 1)))

    @property
    def _touched(self) -> list[Region]:
        """The regions of this session: all but those that an earlier one left, unchanged."""
        assert self.atlas is not None
        return [region for region in self.atlas.regions.values() if not region.untouched]

    def _next_to_refine(self, most: int) -> tuple[Region, int]:
        """The region whose turn it is, and at most so many steps of those that it gets.

        In one round every region gets steps in proportion to its keyframes, all at once: waking
        it costs as much as some of them.
        """
        assert self.atlas is not None
        regions = self._touched
        if self._refined.left <= 0:
            self._refined.region = (self._refined.region + 1) % len(regions)
            mean = sum(len(each.keyframes) for each in regions) / len(regions)
            share = len(regions[self._refined.region].keyframes) / max(mean, 1.0)
            turn = REFINING_STEPS if len(regions) == 1 else TURN_STEPS
            self._refined.left = max(1, round(turn * share))
        portion = min(most, self._refined.left)
        self._refined.left -= portion
        return regions[self._refined.region % len(regions)], portion

    def finish(self) -> None:
        """Refine once more over everything seen; then mark the observed space anew."""
        total = self.refining_steps
        for done in range(0, total, REFINING_STEPS):
            self.refine(min(REFINING_STEPS, total - done), done / total)
        self.settle()

    def settle(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        self._finish_training()
        if self.atlas is None:
            return
        for region in self._touched:
            with self.atlas.awake(region):
                region.version += self.atlas.rebuild_mask(region)
        self._look()

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame as it is known now."""
        return self._history.trajectory()

    def online_trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it was known when the frame was done."""
        return self._history.online_trajectory()

    def _sample(self, frame: RgbdFrame, pixels: TrustedPixels, count: int) -> Rays:
        return rays_at(frame, *pixels.choose(count, self._generator))

    def _finish_training(self) -> Training:
        """Wait for the training that runs, and let tracking see what it did."""
        trained = self._worker.wait()
        if trained is None:
            return self._latest_training
        for region in self._trained:
            region.version += 1
        if self._steps_owed:
            self._steps_owed = max(0, self._steps_owed - trained.losses.steps)
        self._look()
        self._latest_training = trained
        return trained

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
        linked = None
        if is_keyframe:
            linked = self._add_keyframe(frame, pixels, pose, pending.result.odometry)
        current = self._sample(frame, pixels, CURRENT_FRAME_RAYS)
        mapping = self.config.mapping
        steps = mapping.keyframe_iterations if is_keyframe else mapping.iterations
        steps += min(self._steps_owed, MADE_UP_A_FRAME)
        self._look()
        self._trained = self._next_to_train()
        self._worker.start(partial(self._train, self._trained, steps, current, pose, linked))
        return is_keyframe

    def _next_to_train(self) -> list[Region]:
        """The working region, and in turn one of the others that contain the camera.

        So a frame costs the same at a corner, where eight regions meet, as between two.
        """
        assert self.atlas is not None
        others = [region for region in self.atlas.training if region.confirmed]
        self._turn += 1
        return [self.atlas.working, *(others[self._turn % len(others)] for _ in others[:1])]

    def _train(
        self,
        regions: list[Region],
        steps: int,
        current: Rays,
        pose: Pose,
        linked: tuple[int, RgbdFrame, Rays] | None,
    ) -> Training:
        """Train the working region, which comes first, and the other one half as long."""
        assert self.atlas is not None
        started = time.perf_counter()
        self.atlas.settle()
        if linked is not None and self._linker is not None:
            for link in self._linker.link(*linked, self._frames_wait):
                self.keyframes.add_link(link.first, link.second, link.T_first_second)
            if self.recogniser is not None:
                corrections = self.recogniser.corrections
                for region in self.atlas.doubtful[:1]:
                    self.recogniser.ask(region, *linked)
                if self.recogniser.corrections > corrections:
                    pose = self.keyframes.pose(linked[0])
        least = self.config.mapping.min_iterations
        losses = self.optimizer.train(
            regions[0], steps, current, pose, enough=partial(self._may_end, least)
        )
        for region in regions[1:]:
            self.optimizer.train(
                region,
                steps // 2,
                current,
                pose,
                refine_poses=False,
                enough=partial(self._may_end, least // 2),
            )
        return Training(losses, (time.perf_counter() - started) * 1e3)

    def _may_end(self, least: int, done: int) -> bool:
        return done >= least and self._frames_wait()

    def _start(self, pending: _Pending) -> None:
        """The first frame defines the map frame and trains the first region from nothing."""
        frame, pose = pending.frame, pending.tracked.T_map_camera
        self.atlas = RegionAtlas(
            self.config, pose[:3, 3], self.keyframes, self._seed, self._scratch
        )
        if self._linker is not None and self.config.regions.close_loops:
            self.recogniser = RegionRecogniser(self.atlas, self._linker)
        self._add_keyframe(frame, pending.pixels, pose, pending.result.odometry)
        self._trained = [self.atlas.working]
        self._steps_owed = self.config.mapping.first_iterations
        self._worker.start(self._train_first)

    def _train_first(self) -> Training:
        assert self.atlas is not None
        started = time.perf_counter()
        least = math.ceil(FIRST_STEPS_SHARE * self._steps_owed)
        losses = self.optimizer.train(
            self.atlas.working,
            self._steps_owed,
            refine_poses=False,
            enough=partial(self._may_end, least),
        )
        return Training(losses, (time.perf_counter() - started) * 1e3)

    def _add_keyframe(
        self,
        frame: RgbdFrame,
        pixels: TrustedPixels,
        pose: Pose,
        odometry: OdometryEstimate | None,
    ) -> tuple[int, RgbdFrame, Rays]:
        """Make the frame a keyframe, linked to the last one where odometry never failed since."""
        assert self.atlas is not None
        rays = self._sample(frame, pixels, self.config.keyframes.rays)
        link = None
        if odometry is not None and self._keyframe_odometry is not None:
            link = inverse(self._keyframe_odometry.T_odom_camera) @ odometry.T_odom_camera
        self._keyframe_odometry = odometry if odometry is not None and odometry.valid else None
        number = self.keyframes.add(frame.stamp_ns, pose, rays)
        if link is not None:
            self.keyframes.add_link(number - 1, number, link, ODOMETRY_LINK_WEIGHT)
        self.atlas.add_keyframe(number)
        return number, frame, rays
