"""What becomes of a camera that is covered, or carried elsewhere, while the map goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.evaluation.alignment import associate, rigid_alignment
from meslam_core.frame import RgbdFrame
from meslam_core.frame_result import FrameResult, TrackingState
from meslam_core.odometry import Odometry
from meslam_core.recordings.recording import Recording
from meslam_core.se3 import Pose, inverse, rotation_angle
from meslam_core.slam import Slam
from meslam_core.trajectory import Trajectory

COVERED, KIDNAPPED, UNSEEN = "covered", "kidnapped", "unseen"
# A pose that is called good and farther off than this is a confident wrong one.
WRONG_M = 0.2
# A camera is found that is called found with at most this error.
FOUND_M, FOUND_RAD = 0.05, float(np.deg2rad(3.0))
NANOSECONDS = 1e-9


@dataclass(frozen=True)
class Trial:
    """One disturbance.

    Attributes:
        kind: COVERED: without image or depth for a while, then at another place; KIDNAPPED: at
            another place from one frame to the next; UNSEEN: covered, then in the mirror image of
            the place, where nobody has ever been.
        back: frame of the recording at which the camera sees again.
        frames: so many are seen from there on.
    """

    kind: str
    back: int
    frames: int


@dataclass(frozen=True)
class Outcome:
    """What became of it.

    Attributes:
        trial: what was done.
        jump_m, jump_rad: how far the camera was carried.
        found_s: time from the first frame that was seen until the state was OK; None if never.
        error_m, error_rad: of the pose then; NaN if never.
        worst_m: largest error of all poses whose state was OK; 0 without any.
        wrong: number of frames with the state OK and a pose more than `WRONG_M` off, or in a place
            that does not exist.
        states: of all frames.
        reason: what was said of the last one.
    """

    trial: Trial
    jump_m: float
    jump_rad: float
    found_s: float | None
    error_m: float
    error_rad: float
    worst_m: float
    wrong: int
    states: tuple[TrackingState, ...]
    reason: str

    def within(self, seconds: float) -> bool:
        """Whether the camera was found in so short a time, where it is."""
        soon = self.found_s is not None and self.found_s <= seconds
        return bool(soon and self.error_m <= FOUND_M and self.error_rad <= FOUND_RAD)


class Disturbed:
    """A session that goes on after a recording has been mapped, with one disturbance after another.

    Args:
        slam: has mapped the recording.
        odometry: that it was mapped with.
        recording: its frames.
        truth: T_truth_camera of them.

    Attributes:
        slam: the session.
    """

    def __init__(
        self, slam: Slam, odometry: Odometry, recording: Recording, truth: Trajectory
    ) -> None:
        self.slam = slam
        self._odometry = odometry
        self._recording = recording
        self._truth = truth
        mapped = slam.trajectory()
        self._T_truth_map = map_alignment(mapped, truth)
        self._stamp_ns = int(mapped.stamps_ns[-1])
        self._period_ns = int(np.median(np.diff(mapped.stamps_ns)))
        self._last = self._true_pose(self._stamp_ns)

    @property
    def per_second(self) -> float:
        """Frames a second."""
        return 1.0 / (self._period_ns * NANOSECONDS)

    def run(self, trial: Trial, covered_s: float = 5.0) -> Outcome:
        """Disturb the camera, and see what becomes of it.

        Args:
            trial: what is done.
            covered_s: how long it sees nothing, unless it is kidnapped.
        """
        states: list[TrackingState] = []
        errors: list[float] = []
        reason = ""
        found: tuple[float, float, float] | None = None
        start, frames = self._last, list(self._recording.frames(trial.back, trial.back + 1))
        if trial.kind != KIDNAPPED:
            for _ in range(round(covered_s * self.per_second)):
                states.append(self._process(dark(frames[0])).state)
        began_ns = self._stamp_ns + self._period_ns
        jump = inverse(start) @ self._true_pose(frames[0].stamp_ns)
        wrong = 0
        for frame in self._recording.frames(trial.back, trial.back + trial.frames):
            seen = mirrored(frame) if trial.kind == UNSEEN else frame
            result = self._process(seen)
            states.append(result.state)
            reason = result.reason
            if trial.kind != UNSEEN:
                self._last = self._true_pose(frame.stamp_ns)
            if result.state is not TrackingState.OK:
                continue
            error_m, error_rad = self._error(result, frame.stamp_ns)
            errors.append(error_m)
            wrong += error_m > WRONG_M or trial.kind == UNSEEN
            if found is None:
                found = (result.stamp_ns - began_ns) * NANOSECONDS, error_m, error_rad
        found_s, error_m, error_rad = found or (None, np.nan, np.nan)
        return Outcome(
            trial,
            float(np.linalg.norm(jump[:3, 3])),
            rotation_angle(jump),
            found_s,
            error_m,
            error_rad,
            max(errors, default=0.0),
            wrong,
            tuple(states),
            reason,
        )

    def _process(self, frame: RgbdFrame) -> FrameResult:
        self._stamp_ns += self._period_ns
        frame = replace(frame, stamp_ns=self._stamp_ns)
        return self.slam.process(frame, self._odometry.process(frame))

    def _true_pose(self, stamp_ns: int) -> Pose:
        nearest = int(np.argmin(np.abs(self._truth.stamps_ns - stamp_ns)))
        return np.asarray(self._truth.poses[nearest], np.float64)

    def _error(self, result: FrameResult, recorded_ns: int) -> tuple[float, float]:
        estimate = self._T_truth_map @ result.T_map_camera
        apart = inverse(self._true_pose(recorded_ns)) @ estimate
        return float(np.linalg.norm(apart[:3, 3])), rotation_angle(apart)


def carried(
    kind: str,
    count: int,
    poses: NDArray[np.float64],
    frames: int,
    least: int,
    seed: int,
    *,
    least_m: float = 0.0,
) -> Iterator[Trial]:
    """Trials one after the other, each of which takes the camera away from where the last ended.

    Args:
        kind: of all of them.
        count: so many.
        poses: (N, 4, 4) true poses of the frames that were mapped.
        frames: seen in each.
        least: the camera is carried over at least so many frames of the recording.
        seed: of the places.
        least_m: and at least so far [m]; an angle of a radian counts as a metre.
    """
    generator = np.random.default_rng(seed)
    at = len(poses) - 1
    last = len(poses) - frames
    for _ in range(count):
        starts = np.arange(last + 1)
        apart = np.array([_distance(poses[at], pose) for pose in poses[: last + 1]])
        far = (np.abs(starts - at) >= least) & (apart >= least_m)
        if not far.any():
            raise ValueError(
                f"nothing in {len(poses)} frames is {least} frames and {least_m} m from frame {at}"
            )
        back = int(generator.choice(starts[far]))
        yield Trial(kind, back, frames)
        at = back + frames - 1


def mirrored(frame: RgbdFrame) -> RgbdFrame:
    """What the camera would see in a mirror world, left and right exchanged."""
    camera = frame.camera
    return RgbdFrame(
        frame.stamp_ns,
        np.ascontiguousarray(frame.color[:, ::-1]),
        np.ascontiguousarray(frame.depth_m[:, ::-1]),
        PinholeCamera(
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.width - 1.0 - camera.cx,
            camera.cy,
        ),
    )


def dark(frame: RgbdFrame) -> RgbdFrame:
    """What a covered camera sees at that instant: no light, no depth."""
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def map_alignment(mapped: Trajectory, truth: Trajectory) -> Pose:
    """T_truth_map (4, 4) by positions and, where these span little, by directions.

    Args:
        mapped: T_map_camera.
        truth: T_truth_camera of some of the same instants.
    """
    estimate, reference = associate(mapped, truth)
    return rigid_alignment(_around(estimate), _around(reference))


def _around(trajectory: Trajectory) -> NDArray[np.float64]:
    """Points (4 N, 3) a metre along the axes of all cameras, and their centres [m]."""
    ends = trajectory.positions[:, None] + np.swapaxes(trajectory.rotations, 1, 2)
    return np.concatenate([trajectory.positions, ends.reshape(-1, 3)])


def _distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    apart = inverse(first) @ second
    return float(np.linalg.norm(apart[:3, 3])) + rotation_angle(apart)
