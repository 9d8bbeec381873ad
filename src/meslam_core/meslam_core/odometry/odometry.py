"""What every odometry answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose


@dataclass(frozen=True)
class OdometryEstimate:
    """Pose of one frame in the odometry's own, drifting frame.

    Attributes:
        stamp_ns: of the image [ns].
        T_odom_camera: (4, 4).
        covariance: (6, 6) of (translation [m], rotation [rad]) of the last motion, camera frame.
        fitness: share of points with a correspondence, in [0, 1].
        residual_m: RMS distance of the correspondences [m].
        valid: whether the registration passed its checks; an invalid one continues the last
            motion and must not be trusted.
        reason: why it is invalid, empty otherwise.
    """

    stamp_ns: int
    T_odom_camera: Pose
    covariance: NDArray[np.float64]
    fitness: float
    residual_m: float
    valid: bool
    reason: str = ""


class Odometry(Protocol):
    """Estimates motion from one frame to the next."""

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        """Register the next frame; the first one is the origin of the odometry frame."""
        ...
