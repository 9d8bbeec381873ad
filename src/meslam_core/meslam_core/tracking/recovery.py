"""When a camera that was lost counts as found: two frames in a row tell the same place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meslam_core.config import RelocalisationConfig
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import Pose, inverse, rotation_angle

NANOSECONDS = 1e-9


@dataclass(frozen=True)
class _Recognised:
    """Where a frame was recognised, and its odometry."""

    T_map_camera: Pose
    odometry: OdometryEstimate | None


class Recovery:
    """Holds where the frame before was recognised against where this one is.

    Each frame is looked for by itself, so that a chance likeness of two places, which depends on
    the view, hardly tells the same place twice.

    Args:
        config: how well the two must agree.

    Attributes:
        searched_s: for so long no frame of those that showed anything was recognised [s].
    """

    def __init__(self, config: RelocalisationConfig) -> None:
        self.searched_s = 0.0
        self._config = config
        self._latest: _Recognised | None = None
        self._since_ns: int | None = None

    def reset(self) -> None:
        """Nothing is being looked for, or nothing can be seen."""
        self._latest = self._since_ns = None
        self.searched_s = 0.0

    def miss(self, stamp_ns: int) -> None:
        """A frame, of a stamp [ns], was not recognised."""
        self._latest = None
        if self._since_ns is None:
            self._since_ns = stamp_ns
        self.searched_s = (stamp_ns - self._since_ns) * NANOSECONDS

    def confirms(self, T_map_camera: Pose, odometry: OdometryEstimate | None) -> bool:
        """Whether a frame was recognised where the one before was, moved by odometry.

        Args:
            T_map_camera: (4, 4) where it was recognised.
            odometry: its estimate; without a valid one the camera is taken to stand still.
        """
        before, self._latest = self._latest, _Recognised(T_map_camera, odometry)
        if before is None:
            return False
        expected = before.T_map_camera
        if odometry is not None and odometry.valid and before.odometry is not None:
            expected = expected @ inverse(before.odometry.T_odom_camera) @ odometry.T_odom_camera
        apart = inverse(expected) @ T_map_camera
        return float(np.linalg.norm(apart[:3, 3])) <= self._config.agreement_m and rotation_angle(
            apart
        ) <= np.deg2rad(self._config.agreement_deg)
