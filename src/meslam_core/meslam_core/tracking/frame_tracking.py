"""A frame's pose: first guesses, alignment with the map, and how far the result is trusted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import RelocalisationConfig, TrackingConfig
from meslam_core.frame_result import TrackingState
from meslam_core.mapping.keyframes import Rays
from meslam_core.odometry import MotionNoise, OdometryEstimate
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, orthonormalized
from meslam_core.tracking.field_tracker import Alignment, FieldTracker, PosePrior
from meslam_core.tracking.frame_history import FrameHistory
from meslam_core.tracking.judge import Attest, Judge, Verdict, Witness
from meslam_core.tracking.plausibility import Plausibility
from meslam_core.tracking.recovery import Recovery
from meslam_core.tracking.sighting import Sighting

# Below this share of inliers the other first guesses are tried too.
CONFIDENT_INLIERS = 0.85
UNTRUSTED_VARIANCE = 0.25
FIRST_VARIANCE = 1e-8
# Of the pose that a run in a known map is said to begin at.
START_VARIANCE = 0.01
# How far the last motion, continued for a second, may be wrong where odometry says nothing.
CONTINUED_NOISE = MotionNoise(distance_m=0.3, angle_rad=0.45, drift=0.5)
NANOSECONDS = 1e-9


@dataclass(frozen=True)
class TrackedPose:
    """A pose and what it rests on.

    Attributes:
        T_map_camera: (4, 4).
        covariance: (6, 6) of (translation [m], rotation [rad]), map axes.
        trusted: whether it may train the map.
        reason: why the field did not confirm it; empty where it did.
        alignment: with the field, where there was enough to align.
        reference: number of the keyframe it was recognised in; None where tracking went on.
    """

    T_map_camera: Pose
    covariance: NDArray[np.float64]
    trusted: bool
    reason: str
    alignment: Alignment | None
    reference: int | None = None


class FrameTracking:
    """Finds the pose of one frame after the other.

    Args:
        config: limits of what is believed.
        T_map_first: (4, 4) where the first frame is believed to be.
        relocalisation: what finds it again when it is lost.

    Attributes:
        history: of all frames; who maps the frame adds it.
        state: after the latest frame.
    """

    def __init__(
        self,
        config: TrackingConfig,
        T_map_first: Pose | None = None,
        relocalisation: RelocalisationConfig | None = None,
    ) -> None:
        self.config = config
        self._T_map_first = np.eye(4) if T_map_first is None else T_map_first
        self.history = FrameHistory()
        self.state = TrackingState.INITIALISING
        self._tracker = FieldTracker(config)
        self._noise = registered_noise(config)
        self._plausibility = Plausibility(config, self.history)
        relocalisation = relocalisation or RelocalisationConfig()
        self._judge = Judge(config, relocalisation, self._plausibility)
        self._recovery = Recovery(relocalisation)
        self._untrusted = 0
        self._led_on = False
        self._covariance = np.eye(6) * FIRST_VARIANCE

    @property
    def lost(self) -> bool:
        """Whether the camera has to be found in the map before tracking goes on."""
        return self.state in (TrackingState.LOST, TrackingState.RELOCALISING)

    def take_refuted(self) -> int | None:
        """The keyframes from this number on were not taken where they seemed to be; told once."""
        since, self._judge.refuted_since = self._judge.refuted_since, None
        return since

    @property
    def believed(self) -> Pose:
        """Where a lost camera was last, or where odometry from elsewhere has it, (4, 4)."""
        return self.history.pose(-1) if self._led_on else self._plausibility.last_believed

    def start(self, T_map_camera: Pose) -> TrackedPose:
        """The first frame's pose is given."""
        self.state = TrackingState.OK
        return TrackedPose(T_map_camera, self._covariance, trusted=True, reason="", alignment=None)

    def track(
        self,
        stamp_ns: int,
        region: Region,
        rays: Rays | None,
        odometry: OdometryEstimate | None,
        witness: Witness = lambda before: None,
        attest: Attest = lambda pose: False,
    ) -> TrackedPose:
        """Find a frame's pose.

        Args:
            stamp_ns: of its image [ns].
            region: the working region.
            rays: of the frame, camera frame; None where it has too little depth.
            odometry: its estimate, where there is one.
            witness: tells where it was taken; asked where odometry has failed.
            attest: tells whether it was taken at a pose; asked where only odometry leads there.
        """
        alignment = None
        verdict = Verdict(trusted=False, reason="too few pixels with depth")
        self._plausibility.pass_by(odometry)
        if self.lost:
            return self._still_lost(odometry)
        prior = self._prior(stamp_ns, odometry)
        if rays is not None:
            alignment = self._align(region, rays, self._guesses(stamp_ns, odometry), prior)
            verdict = self._judge.verdict(stamp_ns, region, rays, alignment, prior, witness, attest)
        if alignment is not None and verdict.confirmed:
            return self._confirmed(stamp_ns, alignment)
        if verdict.trusted:
            self._plausibility.accept(stamp_ns)
        if alignment is not None and verdict.guessed:
            return self._guessed(alignment, verdict)
        self._untrusted = 0 if verdict.trusted else self._untrusted + 1
        if self._untrusted >= self.config.lost_after_frames or verdict.elsewhere:
            self.state = TrackingState.LOST
            self._recovery.reset()
        else:
            self.state = TrackingState.DEGRADED
        # Uncertainty grows from where it was: without a bound, the next frame could slide
        # anywhere along a plain wall.
        self._covariance = np.eye(6) * UNTRUSTED_VARIANCE if self.lost else prior.covariance
        return TrackedPose(
            prior.T_map_camera, self._covariance, verdict.trusted, verdict.reason, alignment
        )

    def recover(
        self, stamp_ns: int, sighting: Sighting | None, odometry: OdometryEstimate | None
    ) -> TrackedPose | None:
        """Take up where a lost camera was recognised; it is found when two frames agree.

        Args:
            stamp_ns: of the frame's image [ns].
            sighting: what was found; None where it was not recognised.
            odometry: of the frame, where there is one.

        Returns:
            The frame's pose, to be trusted or not; None where it is as lost as it was.
        """
        if sighting is None:
            self.state = TrackingState.LOST
            self._recovery.miss(stamp_ns)
            return None
        alignment = sighting.alignment
        if self._recovery.confirms(alignment.T_map_camera, odometry):
            self._recovery.reset()
            self.history.break_off()
            return replace(self._confirmed(stamp_ns, alignment), reference=sighting.keyframe)
        self.state = TrackingState.RELOCALISING
        reason = "recognised once; a second frame has to agree"
        return TrackedPose(alignment.T_map_camera, self._covariance, False, reason, alignment)

    def go_blind(self) -> None:
        """A lost camera sees nothing that it could be recognised by."""
        self.state = TrackingState.LOST
        self._recovery.reset()

    @property
    def searched_s(self) -> float:
        """For how long a lost camera that sees something has been looked for in vain [s]."""
        return self._recovery.searched_s

    def _confirmed(self, stamp_ns: int, alignment: Alignment) -> TrackedPose:
        """The field tells the pose."""
        self._untrusted = 0
        self.state = TrackingState.OK
        self._covariance = inverted(alignment.information + np.eye(6))
        self._plausibility.confirm(stamp_ns)
        return TrackedPose(alignment.T_map_camera, self._covariance, True, "", alignment)

    def _guessed(self, alignment: Alignment, verdict: Verdict) -> TrackedPose:
        """The field tells the pose, if the camera is where it seems to be."""
        self._untrusted = 0
        self.state = TrackingState.DEGRADED
        self._covariance = inverted(alignment.information + np.eye(6))
        return TrackedPose(
            alignment.T_map_camera, self._covariance, verdict.trusted, verdict.reason, alignment
        )

    def _still_lost(self, odometry: OdometryEstimate | None) -> TrackedPose:
        """Where odometry alone has a lost camera, or else where it was."""
        moved = self.history.moved(odometry)
        pose = self.history.pose(-1) if moved is None else orthonormalized(moved[0] @ moved[1])
        # Odometry by registration does not see the way that the camera was carried in the dark.
        self._led_on = odometry is not None and odometry.noise is not None
        reason = "lost: nothing in the map looks like this view"
        return TrackedPose(pose, np.eye(6) * UNTRUSTED_VARIANCE, False, reason, None)

    def _align(
        self, region: Region, rays: Rays, guesses: list[Pose], prior: PosePrior
    ) -> Alignment:
        """The best alignment with a region from all first guesses that are worth trying."""
        alignments: list[Alignment] = []
        for guess in self._tracker.ranked(region, rays, guesses):
            alignments.append(self._tracker.align(region, rays, guess, prior))
            if alignments[-1].inlier_ratio > CONFIDENT_INLIERS:
                break
        return max(alignments, key=lambda alignment: alignment.inlier_ratio)

    def _prior(self, stamp_ns: int, odometry: OdometryEstimate | None) -> PosePrior:
        """The last pose moved by odometry, or else by the last motion; as certain as both are."""
        if not len(self.history):
            return PosePrior(self._T_map_first.copy(), np.eye(6) * START_VARIANCE)
        moved = self.history.moved(odometry)
        if moved is not None:
            T_map_last, motion = moved
            noise = (odometry.noise if odometry else None) or self._noise
        else:
            T_map_last = self.history.pose(-1)
            noise = CONTINUED_NOISE.over((stamp_ns - self.history.last_stamp_ns) * NANOSECONDS)
            motion = inverse(T_map_last) @ self.history.extrapolated(stamp_ns)
        variances = np.repeat(np.square(noise.deviations(motion)), 3)
        covariance = self._covariance + np.diag(variances)
        return PosePrior(orthonormalized(T_map_last @ motion), covariance)

    def _guesses(self, stamp_ns: int, odometry: OdometryEstimate | None) -> list[Pose]:
        """First guesses of a pose: odometry since the last frame, constant velocity, standstill."""
        if not len(self.history):
            return [self._T_map_first.copy()]
        guesses = []
        moved = self.history.guessed(odometry)
        if moved is not None:
            guesses.append(moved[0] @ moved[1])
        guesses.append(self.history.extrapolated(stamp_ns))
        guesses.append(self.history.pose(-1))
        return [orthonormalized(guess) for guess in guesses]


def registered_noise(config: TrackingConfig) -> MotionNoise:
    """How far odometry by registration may be wrong."""
    return MotionNoise(
        distance_m=config.odometry_sigma_m,
        angle_rad=float(np.deg2rad(config.odometry_sigma_deg)),
        drift=config.odometry_drift,
    )


def inverted(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a covariance or information matrix (6, 6)."""
    return np.asarray(np.linalg.inv(matrix), np.float64)
