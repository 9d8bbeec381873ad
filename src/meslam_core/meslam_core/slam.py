"""The pipeline: odometry gives a first guess, tracking refines it, joint optimisation maps."""

from __future__ import annotations

import enum
import math
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MeslamConfig
from meslam_core.field import field_device
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.joint_optimizer import JointOptimizer, StepLosses
from meslam_core.mapping.keyframe_policy import KeyframePolicy
from meslam_core.mapping.keyframes import KeyframeStore, Rays, rays_at
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.se3 import Pose, exp, inverse, log, orthonormalized, rotation_angle
from meslam_core.tracking.field_tracker import Alignment, FieldTracker, PosePrior
from meslam_core.tracking.pixels import choose_pixels, trusted_pixels
from meslam_core.trajectory import Trajectory

# The first camera looks along the map's x axis and z points up (REP-103).
T_BODY_OPTICAL: Pose = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
CURRENT_FRAME_RAYS = 4096
MIN_FRAME_PIXELS = 200
# Below this share of inliers the other first guesses are tried too.
CONFIDENT_INLIERS = 0.85
UNTRUSTED_VARIANCE = 0.25
# Odometry is carried over at most so many frames that have none.
MAX_ODOMETRY_GAP = 10
# A refinement comes in portions of so many steps, the last at this share of the learning rate.
REFINING_STEPS = 50
LAST_RATE_FACTOR = 0.05
FIRST_VARIANCE = 1e-8


class TrackingState(enum.IntEnum):
    """How far the latest pose can be trusted."""

    INITIALISING = 0
    OK = 1
    DEGRADED = 2
    LOST = 3
    RELOCALISING = 4


@dataclass(frozen=True)
class FrameResult:
    """What is known of a frame when its processing ends.

    Attributes:
        stamp_ns: of the image [ns].
        T_map_camera: (4, 4) online pose.
        covariance: (6, 6) of (translation [m], rotation [rad]), map axes.
        state, reason: of tracking.
        odometry: estimate it started from, if there was one.
        residual_m: median distance of the frame's points to the mapped surface [m].
        inlier_ratio: share of points near the surface.
        losses: mean of the mapping steps.
        iterations: mapping steps taken.
        is_keyframe: whether the frame became a keyframe.
        tracking_ms, mapping_ms: time spent.
    """

    stamp_ns: int
    T_map_camera: Pose
    covariance: NDArray[np.float64]
    state: TrackingState
    reason: str
    odometry: OdometryEstimate | None
    residual_m: float
    inlier_ratio: float
    losses: StepLosses
    iterations: int
    is_keyframe: bool
    tracking_ms: float
    mapping_ms: float


@dataclass(frozen=True)
class _Verdict:
    """Whether a frame's pose may train the map, and whether the field confirmed it."""

    trusted: bool
    by_field: bool = False
    reason: str = ""


@dataclass
class _TrackedFrame:
    """A frame's place in the trajectory: relative to a keyframe, so that it moves with it."""

    stamp_ns: int
    T_map_camera_online: Pose
    keyframe: int
    T_keyframe_camera: Pose
    odometry: OdometryEstimate | None = field(repr=False, default=None)


class Slam:
    """Tracks frames and maps what they see.

    Frames come in the order of their stamps; one object serves one continuous recording.

    Args:
        config: all numbers.
        seed: of every random choice; the same frames and seed give the same result.
        T_map_camera: (4, 4) pose of the first frame; by default the first camera defines the
            map frame, x forward and z up.

    Attributes:
        state: of tracking.
        effort: share of the configured mapping steps that a frame gets, in (0, 1]; a live system
            lowers it when it falls behind the camera.
    """

    def __init__(
        self, config: MeslamConfig, seed: int = 0, T_map_camera: Pose = T_BODY_OPTICAL
    ) -> None:
        self.config = config
        self.device = field_device(config.field)
        self.keyframes = KeyframeStore(config.keyframes.rays, self.device)
        self.optimizer = JointOptimizer(self.keyframes, config.mapping, seed)
        self.tracker = FieldTracker(config.tracking)
        self.policy = KeyframePolicy(config.keyframes, config.field)
        self.atlas: RegionAtlas | None = None
        self.state = TrackingState.INITIALISING
        self.effort = 1.0
        self._seed = seed
        self._generator = np.random.default_rng(seed)
        self._T_map_first = T_map_camera
        self._frames: list[_TrackedFrame] = []
        self._untrusted = 0
        self._covariance = np.eye(6) * FIRST_VARIANCE
        self._keyframe_odometry: OdometryEstimate | None = None

    def process(self, frame: RgbdFrame, odometry: OdometryEstimate | None = None) -> FrameResult:
        """Track one frame and train the map with it.

        Args:
            frame: the next image pair.
            odometry: its external odometry; without one, the last motion is continued.
        """
        started = time.perf_counter()
        pixels = trusted_pixels(frame.depth_m, self.config.sensor)
        enough = np.count_nonzero(pixels) >= MIN_FRAME_PIXELS
        if self.atlas is None and enough:
            return self._start(frame, pixels, odometry, started)
        alignment, verdict = None, _Verdict(trusted=False, reason="too few pixels with depth")
        if self.atlas is not None and enough:
            alignment, verdict = self._track(frame, pixels, odometry)
        pose = self._accept(frame.stamp_ns, alignment, verdict, odometry)
        self._covariance = _covariance(alignment if verdict.by_field else None)
        if odometry is not None and not odometry.valid:
            self._keyframe_odometry = None
        tracked = time.perf_counter()
        losses, iterations, is_keyframe = StepLosses(), 0, False
        if self.atlas is not None and verdict.trusted:
            losses, iterations, is_keyframe = self._map(frame, pixels, pose, odometry)
        self._remember(frame, pose, odometry)
        mapped = time.perf_counter()
        return FrameResult(
            stamp_ns=frame.stamp_ns,
            T_map_camera=pose,
            covariance=self._covariance,
            state=self.state,
            reason=verdict.reason,
            odometry=odometry,
            residual_m=alignment.residual_m if alignment else float("inf"),
            inlier_ratio=alignment.inlier_ratio if alignment else 0.0,
            losses=losses,
            iterations=iterations,
            is_keyframe=is_keyframe,
            tracking_ms=(tracked - started) * 1e3,
            mapping_ms=(mapped - tracked) * 1e3,
        )

    def refine(self, steps: int, progress: float = 0.0) -> None:
        """Train on what was seen for `steps` steps, over all regions; keyframe poses follow.

        Args:
            steps: number of Adam steps.
            progress: share of the whole refinement that is done, in [0, 1]; the learning rate
                falls with it, and with it the noise that training leaves in the map.
        """
        if self.atlas is None:
            return
        total = sum(len(region.keyframes) for region in self.atlas.regions.values())
        for region in self.atlas.regions.values():
            share = len(region.keyframes) / max(total, 1)
            self.optimizer.train(
                region,
                max(1, round(steps * share)),
                rate_factor=1.0 + progress * (LAST_RATE_FACTOR - 1.0),
            )
            region.version += 1

    def finish(self) -> None:
        """Refine once more over everything seen; then mark the observed space anew."""
        total = self.config.mapping.final_iterations
        for done in range(0, total, REFINING_STEPS):
            self.refine(min(REFINING_STEPS, total - done), done / total)
        self.settle()

    def settle(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        if self.atlas is None:
            return
        self.atlas.rebuild_masks()
        for region in self.atlas.regions.values():
            region.version += 1

    def trajectory(self) -> Trajectory:
        """T_map_camera of every tracked frame as it is known now."""
        return Trajectory(
            self._stamps(),
            np.array([self._current_pose(f) for f in self._frames]).reshape(-1, 4, 4),
        )

    def online_trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it was known when the frame was done."""
        poses = [f.T_map_camera_online for f in self._frames]
        return Trajectory(self._stamps(), np.array(poses).reshape(-1, 4, 4))

    def _stamps(self) -> NDArray[np.int64]:
        return np.array([f.stamp_ns for f in self._frames], np.int64)

    def _start(
        self,
        frame: RgbdFrame,
        pixels: NDArray[np.bool_],
        odometry: OdometryEstimate | None,
        started: float,
    ) -> FrameResult:
        """The first frame defines the map frame and trains the first region from nothing."""
        pose = self._T_map_first.copy()
        self.atlas = RegionAtlas(self.config, pose[:3, 3], self.keyframes, self._seed)
        self._add_keyframe(frame, pixels, pose, odometry)
        steps = self.config.mapping.first_iterations
        losses = self.optimizer.train(self.atlas.working, steps, refine_poses=False)
        self.atlas.working.version += 1
        self.state = TrackingState.OK
        self._remember(frame, pose, odometry)
        return FrameResult(
            stamp_ns=frame.stamp_ns,
            T_map_camera=pose,
            covariance=self._covariance,
            state=self.state,
            reason="",
            odometry=odometry,
            residual_m=0.0,
            inlier_ratio=1.0,
            losses=losses,
            iterations=steps,
            is_keyframe=True,
            tracking_ms=0.0,
            mapping_ms=(time.perf_counter() - started) * 1e3,
        )

    def _sample(self, frame: RgbdFrame, pixels: NDArray[np.bool_], count: int) -> Rays:
        return rays_at(frame, *choose_pixels(pixels, count, self._generator))

    def _track(
        self, frame: RgbdFrame, pixels: NDArray[np.bool_], odometry: OdometryEstimate | None
    ) -> tuple[Alignment, _Verdict]:
        """Align a frame with the working region and judge the result."""
        assert self.atlas is not None
        region = self.atlas.working
        rays = self._sample(frame, pixels, self.config.tracking.points)
        guesses = self._guesses(frame.stamp_ns, odometry)
        costs = [self.tracker.robust_cost(region, rays, guess) for guess in guesses]
        prior = self._prior(odometry)
        alignments: list[Alignment] = []
        for index in np.argsort(costs):
            alignments.append(self.tracker.align(region, rays, guesses[index], prior))
            if alignments[-1].inlier_ratio > CONFIDENT_INLIERS:
                break
        best = max(alignments, key=lambda alignment: alignment.inlier_ratio)
        return best, self._judge(best, odometry)

    def _moved(self, odometry: OdometryEstimate | None) -> tuple[Pose, Pose] | None:
        """Pose of the last frame that has odometry, and odometry's motion since, both (4, 4).

        None where there is no valid odometry to go by.
        """
        if odometry is None or not odometry.valid:
            return None
        for frame in reversed(self._frames[-MAX_ODOMETRY_GAP:]):
            if frame.odometry is not None:
                motion = inverse(frame.odometry.T_odom_camera) @ odometry.T_odom_camera
                return self._current_pose(frame), motion
        return None

    def _prior(self, odometry: OdometryEstimate | None) -> PosePrior | None:
        """The last pose moved by odometry, as certain as both are."""
        moved = self._moved(odometry)
        if moved is None:
            return None
        T_map_last, motion = moved
        limits = self.config.tracking
        distance = float(np.linalg.norm(motion[:3, 3]))
        sigma_m = limits.odometry_sigma_m + limits.odometry_drift * distance
        sigma_rad = np.deg2rad(limits.odometry_sigma_deg)
        sigma_rad += limits.odometry_drift * rotation_angle(motion)
        variances = np.repeat([sigma_m**2, sigma_rad**2], 3)
        covariance = self._covariance + np.diag(variances)
        mean = orthonormalized(T_map_last @ motion)
        return PosePrior(mean, inverted(covariance))

    def _guesses(self, stamp_ns: int, odometry: OdometryEstimate | None) -> list[Pose]:
        """First guesses of a pose: odometry since the last frame, constant velocity, standstill."""
        guesses = []
        moved = self._moved(odometry)
        if moved is not None:
            guesses.append(moved[0] @ moved[1])
        guesses.append(self._extrapolated(stamp_ns))
        guesses.append(self._latest_pose())
        return [orthonormalized(guess) for guess in guesses]

    def _current_pose(self, frame: _TrackedFrame) -> Pose:
        """A frame's pose through its keyframe, which may have moved since."""
        return self.keyframes.pose(frame.keyframe) @ frame.T_keyframe_camera

    def _latest_pose(self) -> Pose:
        return self._current_pose(self._frames[-1])

    def _extrapolated(self, stamp_ns: int) -> Pose:
        latest = self._latest_pose()
        if len(self._frames) < 2:
            return latest
        before, last = self._frames[-2], self._frames[-1]
        T_map_before = self._current_pose(before)
        elapsed = max(last.stamp_ns - before.stamp_ns, 1)
        ahead = min((stamp_ns - last.stamp_ns) / elapsed, 3.0)
        return latest @ exp(ahead * log(orthonormalized(inverse(T_map_before) @ latest)))

    def _judge(self, alignment: Alignment, odometry: OdometryEstimate | None) -> _Verdict:
        """Whether an alignment may be trusted, or odometry in its place."""
        limits = self.config.tracking
        if not np.isfinite(alignment.T_map_camera).all():
            return _Verdict(trusted=False, reason="the pose is not finite")
        if alignment.observed_ratio < limits.min_observed_ratio:
            # Beyond what is mapped only odometry knows; without it the map could not grow.
            return _Verdict(
                trusted=odometry is not None and odometry.valid,
                reason=f"only {alignment.observed_ratio:.0%} of the view is mapped",
            )
        if alignment.inlier_ratio < limits.min_inlier_ratio:
            share = f"{alignment.inlier_ratio:.0%}"
            return _Verdict(trusted=False, reason=f"only {share} of the points lie on the map")
        if alignment.residual_m > limits.max_residual_m:
            distance = f"{alignment.residual_m * 100:.1f} cm"
            return _Verdict(trusted=False, reason=f"points lie {distance} off the map")
        return _Verdict(trusted=True, by_field=True)

    def _accept(
        self,
        stamp_ns: int,
        alignment: Alignment | None,
        verdict: _Verdict,
        odometry: OdometryEstimate | None,
    ) -> Pose:
        """The frame's pose and the tracking state that follows."""
        if alignment is not None and verdict.by_field:
            self._untrusted = 0
            self.state = TrackingState.OK
            return alignment.T_map_camera
        if self.atlas is None:
            return self._T_map_first.copy()
        self._untrusted = 0 if verdict.trusted else self._untrusted + 1
        lost = self._untrusted >= self.config.tracking.lost_after_frames
        self.state = TrackingState.LOST if lost else TrackingState.DEGRADED
        return self._guesses(stamp_ns, odometry)[0]

    def _map(
        self,
        frame: RgbdFrame,
        pixels: NDArray[np.bool_],
        pose: Pose,
        odometry: OdometryEstimate | None,
    ) -> tuple[StepLosses, int, bool]:
        """Update the regions for the pose, add a keyframe where due, and train."""
        assert self.atlas is not None
        self.atlas.update(pose[:3, 3])
        region = self.atlas.working
        is_keyframe = self.policy.is_keyframe(
            region,
            self.keyframes,
            len(self.keyframes) - 1,
            frame.camera,
            pose,
            self._sample(frame, pixels, self.policy.PIXELS),
        )
        if is_keyframe:
            self._add_keyframe(frame, pixels, pose, odometry)
        current = self._sample(frame, pixels, CURRENT_FRAME_RAYS)
        mapping = self.config.mapping
        wanted = mapping.keyframe_iterations if is_keyframe else mapping.iterations
        steps = math.ceil(wanted * self.effort)
        losses = self.optimizer.train(region, steps, current, pose)
        region.version += 1
        for neighbor in self.atlas.training:
            self.optimizer.train(neighbor, steps // 2, current, pose, refine_poses=False)
            neighbor.version += 1
        return losses, steps, is_keyframe

    def _add_keyframe(
        self,
        frame: RgbdFrame,
        pixels: NDArray[np.bool_],
        pose: Pose,
        odometry: OdometryEstimate | None,
    ) -> None:
        """Make the frame a keyframe, linked to the last one where odometry never failed since."""
        assert self.atlas is not None
        rays = self._sample(frame, pixels, self.config.keyframes.rays)
        link = None
        if odometry is not None and self._keyframe_odometry is not None:
            link = inverse(self._keyframe_odometry.T_odom_camera) @ odometry.T_odom_camera
        self._keyframe_odometry = odometry if odometry is not None and odometry.valid else None
        self.atlas.add_keyframe(self.keyframes.add(frame.stamp_ns, pose, rays, link))

    def _remember(self, frame: RgbdFrame, pose: Pose, odometry: OdometryEstimate | None) -> None:
        if not len(self.keyframes):
            return
        reference = len(self.keyframes) - 1
        T_keyframe_camera = orthonormalized(inverse(self.keyframes.pose(reference)) @ pose)
        self._frames.append(
            _TrackedFrame(frame.stamp_ns, pose, reference, T_keyframe_camera, odometry)
        )


def _covariance(alignment: Alignment | None) -> NDArray[np.float64]:
    """Covariance (6, 6) of a pose; `None` where the field did not confirm it."""
    if alignment is None:
        return np.eye(6) * UNTRUSTED_VARIANCE
    return inverted(alignment.information + np.eye(6))


def inverted(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a covariance or information matrix (6, 6)."""
    return np.asarray(np.linalg.inv(matrix), np.float64)
