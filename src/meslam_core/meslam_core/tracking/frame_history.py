"""All frames' poses: each relative to a keyframe, so that it moves when the keyframe does."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import Pose, exp, inverse, log, orthonormalized
from meslam_core.trajectory import Trajectory

# Odometry is carried over at most so many frames that have none.
MAX_ODOMETRY_GAP = 10
# A motion is extrapolated to at most so many times its duration.
MAX_EXTRAPOLATION = 3.0


class KeyframePoses:
    """Poses of all keyframes at one moment; training that goes on does not change them."""

    def __init__(self, keyframes: KeyframeStore) -> None:
        rotations, translations = keyframes.pose_arrays()
        self._rotations = rotations.copy()
        self._translations = translations.copy()

    def __len__(self) -> int:
        return len(self._translations)

    def pose(self, index: int) -> Pose:
        """T_map_camera (4, 4) of a keyframe."""
        pose = np.eye(4)
        pose[:3, :3] = self._rotations[index]
        pose[:3, 3] = self._translations[index]
        return pose

    def compose(
        self, indices: NDArray[np.int64], T_keyframe_camera: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """T_map_camera (N, 4, 4) from keyframe numbers (N,) and poses (N, 4, 4) in them."""
        poses = np.tile(np.eye(4), (len(indices), 1, 1))
        poses[:, :3, :3] = self._rotations[indices]
        poses[:, :3, 3] = self._translations[indices]
        composed: NDArray[np.float64] = np.matmul(poses, T_keyframe_camera)
        return composed


@dataclass(frozen=True)
class _Measured:
    """A frame that has odometry, by its place in the history."""

    number: int
    odometry: OdometryEstimate


class FrameHistory:
    """Stamps and poses of the frames so far, a few hundred bytes each.

    Attributes:
        keyframes: poses that the frames' poses are given by; replaced when keyframes moved.
    """

    def __init__(self) -> None:
        self.keyframes: KeyframePoses | None = None
        self._count = 0
        self._stamps_ns = np.zeros(64, np.int64)
        self._references = np.zeros(64, np.int64)
        self._relative = np.zeros((64, 4, 4))
        self._online = np.zeros((64, 4, 4))
        self._known = np.zeros(64, np.bool_)
        self._measured: deque[_Measured] = deque(maxlen=MAX_ODOMETRY_GAP)
        # By frame that became a keyframe: how it was tracked in the keyframe before.
        self._handovers: dict[int, Pose] = {}
        # Number of the first frame since the path was last broken off.
        self._begun = 0

    def __len__(self) -> int:
        return self._count

    def add(
        self,
        stamp_ns: int,
        T_map_camera: Pose,
        reference: int,
        T_keyframe_camera: Pose,
        odometry: OdometryEstimate | None,
        known: bool = True,
    ) -> None:
        """Append a frame.

        Args:
            stamp_ns: of its image [ns].
            T_map_camera: (4, 4) as it is known now: the online pose.
            reference: number of its keyframe.
            T_keyframe_camera: (4, 4) in that keyframe.
            odometry: its estimate, where there is one.
            known: whether it is known where the camera was; not while it is lost.
        """
        if self._count == len(self._stamps_ns):
            for name in ("_stamps_ns", "_references", "_relative", "_online", "_known"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self._stamps_ns[self._count] = stamp_ns
        self._references[self._count] = reference
        self._relative[self._count] = T_keyframe_camera
        self._online[self._count] = T_map_camera
        self._known[self._count] = known
        if odometry is not None and (odometry.valid or odometry.noise is None):
            self._measured.append(_Measured(self._count, odometry))
        self._count += 1

    def break_off(self) -> None:
        """The next frame is where it was found, whatever the frames before say of their motion."""
        self._begun = self._count

    def hand_over(self, T_reference_next: Pose) -> None:
        """The next frame becomes a keyframe: how it was tracked in the one before, (4, 4)."""
        if self._begun < self._count:
            self._handovers[self._count] = T_reference_next

    @property
    def last_stamp_ns(self) -> int:
        """Stamp of the latest frame's image [ns]."""
        return int(self._stamps_ns[self._count - 1])

    @property
    def newest_keyframe(self) -> int:
        """Number of the latest keyframe."""
        assert self.keyframes is not None
        return len(self.keyframes) - 1

    def keyframe_pose(self, keyframe: int) -> Pose:
        """T_map_camera (4, 4) of a keyframe as it is known now."""
        assert self.keyframes is not None
        return self.keyframes.pose(keyframe)

    def pose(self, number: int) -> Pose:
        """T_map_camera (4, 4) of a frame as it is known now; -1 is the latest."""
        assert self.keyframes is not None
        number = number + self._count if number < 0 else number
        reference = self.keyframes.pose(int(self._references[number]))
        return np.asarray(reference @ self._relative[number], np.float64)

    def extrapolated(self, stamp_ns: int) -> Pose:
        """T_map_camera (4, 4) at a time after the latest frame, its motion continued."""
        latest = self.pose(-1)
        if self._count - self._begun < 2:
            return latest
        before_ns, last_ns = self._stamps_ns[self._count - 2 : self._count]
        ahead = min((stamp_ns - last_ns) / max(last_ns - before_ns, 1), MAX_EXTRAPOLATION)
        motion = log(orthonormalized(inverse(self.pose(-2)) @ latest))
        return orthonormalized(latest @ exp(ahead * motion))

    def moved(self, odometry: OdometryEstimate | None) -> tuple[Pose, Pose] | None:
        """Pose of the last frame that has odometry, and odometry's motion since, both (4, 4).

        None where there is no valid odometry to go by.
        """
        return self.guessed(odometry) if odometry is not None and odometry.valid else None

    def guessed(self, odometry: OdometryEstimate | None) -> tuple[Pose, Pose] | None:
        """The same of odometry that may be wrong."""
        if odometry is None or not self._measured:
            return None
        last = self._measured[-1]
        if self._count - last.number > MAX_ODOMETRY_GAP or last.number < self._begun:
            return None
        motion = inverse(last.odometry.T_odom_camera) @ odometry.T_odom_camera
        return self.pose(last.number), motion

    def known_trajectory(self) -> Trajectory:
        """`trajectory` without the frames of a lost camera."""
        return self.trajectory().subset(np.flatnonzero(self._known[: self._count]))

    def trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it is known now.

        A frame between two keyframes was tracked in both: in the first directly, in the second
        through how that one was tracked. Where refinement moved them apart, it moves from the one
        to the other in the course of time.
        """
        stamps = self._stamps_ns[: self._count]
        poses = np.zeros((0, 4, 4))
        if self._count:
            assert self.keyframes is not None
            poses = self.keyframes.compose(
                self._references[: self._count], self._relative[: self._count]
            )
        starts = np.flatnonzero(np.diff(self._references[: self._count], prepend=-1))
        for start, end in pairwise(starts.tolist()):
            if end not in self._handovers:
                continue
            T_map_next = self.keyframe_pose(int(self._references[end]))
            T_next_reference = inverse(self._handovers[end])
            duration = max(int(stamps[end] - stamps[start]), 1)
            for number in range(start + 1, end):
                through_next = T_map_next @ T_next_reference @ self._relative[number]
                apart = log(orthonormalized(inverse(poses[number]) @ through_next))
                share = (stamps[number] - stamps[start]) / duration
                poses[number] = poses[number] @ exp(share * apart)
        return Trajectory(stamps.copy(), poses)

    def online_trajectory(self) -> Trajectory:
        """T_map_camera of every frame as it was known when the frame was done."""
        return Trajectory(self._stamps_ns[: self._count].copy(), self._online[: self._count].copy())
