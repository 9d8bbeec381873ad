"""What every odometry answers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, rotation_angle


@dataclass(frozen=True)
class MotionNoise:
    """How far a measured motion may be wrong: one standard deviation.

    Attributes:
        distance_m: of the distance, however short the motion [m].
        angle_rad: of the angle, likewise [rad].
        drift: further error of both, as a share of each.
        drift_rad_m: further error of the angle with the distance travelled [rad/m].
    """

    distance_m: float
    angle_rad: float
    drift: float
    drift_rad_m: float = 0.0

    def over(self, times: float) -> MotionNoise:
        """The noise of `times` as long a motion, as far as it does not depend on the motion."""
        return replace(self, distance_m=times * self.distance_m, angle_rad=times * self.angle_rad)

    def deviations(self, motion: Pose) -> tuple[float, float]:
        """Error of the distance [m] and of the angle [rad] of a motion (4, 4)."""
        distance = float(np.linalg.norm(motion[:3, 3]))
        angle = self.angle_rad + self.drift * rotation_angle(motion) + self.drift_rad_m * distance
        return self.distance_m + self.drift * distance, angle


@dataclass(frozen=True)
class OdometryEstimate:
    """Pose of one frame in the odometry's own, drifting frame.

    Attributes:
        stamp_ns: of the image [ns].
        T_odom_camera: (4, 4).
        covariance: (6, 6) of (translation [m], rotation [rad]) of the last motion, camera frame.
        fitness: share of points with a correspondence, in [0, 1].
        residual_m: RMS distance of the correspondences [m].
        valid: whether the registration passed its checks; an invalid one is a guess, mostly the
            last motion continued, and must not be trusted.
        reason: why it is invalid, empty otherwise.
        noise: of odometry from elsewhere, any two valid estimates of which tell a motion, whatever
            came between. None for what is registered here from frame to frame: the motion from or
            to an invalid estimate is a guess, and `TrackingConfig` says how the others err.
    """

    stamp_ns: int
    T_odom_camera: Pose
    covariance: NDArray[np.float64]
    fitness: float
    residual_m: float
    valid: bool
    reason: str = ""
    noise: MotionNoise | None = None


class Odometry(Protocol):
    """Estimates motion from one frame to the next."""

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        """Register the next frame; the first one is the origin of the odometry frame."""
        ...
