"""Odometry from elsewhere: wheels, a tracking camera, another SLAM."""

from __future__ import annotations

import numpy as np

from meslam_core.config import OdometryConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry.keyframe_odometry import UNKNOWN_VARIANCE
from meslam_core.odometry.odometry import MotionNoise, OdometryEstimate
from meslam_core.se3 import Pose, interpolate, inverse, rotation_angle
from meslam_core.trajectory import Trajectory

NANOSECONDS = 1e-9
# What poses from elsewhere may be corrected by at once, besides the motion itself.
JUMP_M = 0.1
JUMP_RAD = 0.1


def given_noise(config: OdometryConfig) -> MotionNoise:
    """How far odometry from elsewhere may be wrong."""
    return MotionNoise(
        distance_m=config.given_sigma_m,
        angle_rad=float(np.deg2rad(config.given_sigma_deg)),
        drift=config.given_drift,
        drift_rad_m=float(np.deg2rad(config.given_drift_deg_m)),
    )


class GivenOdometry:
    """Poses of the camera that were measured elsewhere, at the instants of the images.

    Only motions between them count, so the frame they are given in does not matter.

    Args:
        poses: T_odom_camera, on the clock of the images.
        config: how far apart two poses may be, and how far their motions may be wrong.
    """

    def __init__(self, poses: Trajectory, config: OdometryConfig) -> None:
        self._poses = poses
        self._config = config
        self._noise = given_noise(config)
        self._last: Pose | None = None
        self._last_stamp_ns = 0
        # Takes jumps out of the given poses: from their frame to the one that goes on smoothly.
        self._T_odom_given: Pose = np.eye(4)

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        """The pose at a frame's stamp; invalid where the poses are too far apart, or jump."""
        T_given_camera, reason = self._at(frame.stamp_ns)
        T_odom_camera = self._T_odom_given @ T_given_camera
        last = T_odom_camera if self._last is None else self._last
        if not reason:
            reason = self._jump(last, T_odom_camera, frame.stamp_ns)
            if reason:
                # Whoever measured them began anew, or took up where it had lost itself.
                self._T_odom_given = last @ inverse(T_given_camera)
                T_odom_camera = last
            self._last, self._last_stamp_ns = T_odom_camera, frame.stamp_ns
        covariance = np.eye(6) * UNKNOWN_VARIANCE
        if not reason:
            deviations = self._noise.deviations(inverse(last) @ T_odom_camera)
            covariance = np.diag(np.repeat(np.square(deviations), 3))
        return OdometryEstimate(
            stamp_ns=frame.stamp_ns,
            T_odom_camera=T_odom_camera,
            covariance=covariance,
            fitness=float(not reason),
            residual_m=0.0,
            valid=not reason,
            reason=reason,
            noise=self._noise,
        )

    def _jump(self, last: Pose, T_odom_camera: Pose, stamp_ns: int) -> str:
        """Why a motion since the last pose is none that a camera makes; empty where it is one."""
        if self._last is None:
            return ""
        motion = inverse(last) @ T_odom_camera
        distance_m, turn_rad = float(np.linalg.norm(motion[:3, 3])), rotation_angle(motion)
        elapsed_s = (stamp_ns - self._last_stamp_ns) * NANOSECONDS
        limits = self._config
        too_far = distance_m > JUMP_M + limits.max_speed_m_s * elapsed_s
        if not too_far and turn_rad <= JUMP_RAD + np.deg2rad(limits.max_turn_deg_s) * elapsed_s:
            return ""
        return (
            f"the given poses jump by {distance_m:.2f} m and {np.rad2deg(turn_rad):.0f} deg in "
            f"{elapsed_s:.3f} s; the jump is left out"
        )

    def _at(self, stamp_ns: int) -> tuple[Pose, str]:
        """The pose (4, 4) at a stamp, and why it is none that was measured; empty if it is."""
        stamps, poses = self._poses.stamps_ns, self._poses.poses
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return poses[after], ""
        if after == 0:
            early_s = (int(stamps[0]) - stamp_ns) * NANOSECONDS
            return poses[0], f"the given poses begin {early_s:.3f} s after the image"
        if after == len(stamps):
            late_s = (stamp_ns - int(stamps[-1])) * NANOSECONDS
            return poses[-1], f"the given poses end {late_s:.3f} s before the image"
        gap_ns = int(stamps[after] - stamps[after - 1])
        fraction = (stamp_ns - int(stamps[after - 1])) / gap_ns
        pose = interpolate(poses[after - 1], poses[after], fraction)
        gap_s = gap_ns * NANOSECONDS
        bridged = gap_s <= self._config.given_gap_s
        return pose, "" if bridged else f"the given poses have a gap of {gap_s:.3f} s"


class NoOdometry:
    """Nothing is known of the motion; tracking continues the last one."""

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        """An invalid estimate."""
        return OdometryEstimate(
            stamp_ns=frame.stamp_ns,
            T_odom_camera=np.eye(4),
            covariance=np.eye(6) * UNKNOWN_VARIANCE,
            fitness=0.0,
            residual_m=0.0,
            valid=False,
            reason="there is no odometry",
        )
