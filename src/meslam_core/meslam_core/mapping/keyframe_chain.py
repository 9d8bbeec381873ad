"""Keyframes one after the other, each tied to the one before by what odometry says."""

from __future__ import annotations

from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import Pose, inverse

# A registration of the two keyframes says it better.
ODOMETRY_LINK_WEIGHT = 0.05


class KeyframeChain:
    """Adds keyframes to a store, linked where odometry never failed between two of them.

    Args:
        keyframes: the store.
    """

    def __init__(self, keyframes: KeyframeStore) -> None:
        self._keyframes = keyframes
        self._latest: OdometryEstimate | None = None

    def pass_by(self, odometry: OdometryEstimate | None) -> None:
        """Note a frame's odometry, also of one that becomes no keyframe."""
        if odometry is not None and not odometry.valid:
            self._latest = None

    def cut(self) -> None:
        """Tie the next keyframe to none: the camera was lost in between."""
        self._latest = None

    def add(
        self, stamp_ns: int, T_map_camera: Pose, rays: Rays, odometry: OdometryEstimate | None
    ) -> int:
        """Append a keyframe and return its number.

        Args:
            stamp_ns: of its image [ns].
            T_map_camera: (4, 4).
            rays: at least one, camera frame.
            odometry: of its frame, where there is some.
        """
        link = None
        if odometry is not None and self._latest is not None:
            link = inverse(self._latest.T_odom_camera) @ odometry.T_odom_camera
        self._latest = odometry if odometry is not None and odometry.valid else None
        number = self._keyframes.add(stamp_ns, T_map_camera, rays)
        if link is not None:
            self._keyframes.add_link(number - 1, number, link, ODOMETRY_LINK_WEIGHT)
        return number
