"""Whether a pose that fits the map can be right: by odometry, by motion, by the colours there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from meslam_core.config import TrackingConfig
from meslam_core.mapping.keyframes import Rays
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, rotation_angle
from meslam_core.tracking.evidence import colour_likeness
from meslam_core.tracking.field_tracker import Alignment, PosePrior
from meslam_core.tracking.frame_history import FrameHistory

# A motion may be so much longer than its limit: what poses err, and stamps.
MOTION_SLACK_M = 0.05
MOTION_SLACK_RAD = 0.05
NANOSECONDS = 1e-9


# Tells whether a frame was taken at a pose (4, 4), by what does not depend on the map's surface;
# None where it cannot tell.
Witness = Callable[[Pose], bool | None]


class Plausibility:
    """Checks what the map's surface alone does not tell.

    A floor fits a floor. As long as valid odometry leads from one trusted pose to the next, the
    pose is where it is said to be within a few centimetres; from the first frame on that odometry
    could not follow it may be anywhere: then the map has to show the frame's colours, too, and a
    keyframe nearby its image.

    Args:
        config: the limits.
        history: of all frames.

    Attributes:
        supported: whether odometry leads from the last pose that the map confirmed to the latest
            frame.
    """

    def __init__(self, config: TrackingConfig, history: FrameHistory) -> None:
        self.supported = False
        self._config = config
        self._history = history
        self._followed = True
        self._has_odometry = False
        self._trusted: tuple[int, int] | None = None

    @property
    def last_trusted(self) -> Pose:
        """T_map_camera (4, 4) of the last frame that the map confirmed, as it is known now."""
        return self._history.pose(self._trusted[0] if self._trusted else 0)

    def pass_by(self, odometry: OdometryEstimate | None) -> None:
        """Note a frame's odometry."""
        valid = odometry is not None and odometry.valid
        self._has_odometry = self._has_odometry or valid
        # Any two poses from elsewhere tell the motion between them, whatever was in between; after
        # a failure of registration the next one may begin at a frame that it knows no pose of.
        registered = odometry is None or odometry.noise is None
        if registered and not valid:
            self._followed = False
        self.supported = valid and self._followed

    def confirm(self, stamp_ns: int) -> None:
        """The map confirms the frame that is going to be added to the history."""
        self._followed = True
        self._trusted = len(self._history), stamp_ns

    def objection(
        self,
        stamp_ns: int,
        region: Region,
        rays: Rays,
        alignment: Alignment,
        prior: PosePrior,
        witness: Witness,
    ) -> str:
        """Why a pose that fits the map is not to be trusted; empty where it is.

        Args:
            stamp_ns: of the frame's image [ns].
            region: whose map it fits.
            rays: of the frame, camera frame.
            alignment: with that map.
            prior: what odometry says of the pose, or else the last motion.
            witness: asked where odometry does not support the pose.
        """
        pose = alignment.T_map_camera
        return (
            self._impossible(stamp_ns, pose)
            or (self.supported and self._conflict(prior, pose))
            or (not self.supported and self._doubt(region, rays, alignment, witness))
            or ""
        )

    def _impossible(self, stamp_ns: int, T_map_camera: Pose) -> str:
        """How the motion since the last trusted frame exceeds what is possible."""
        if self._trusted is None:
            return ""
        number, trusted_ns = self._trusted
        elapsed_s = max((stamp_ns - trusted_ns) * NANOSECONDS, 0.0)
        distance, angle = _motion(self._history.pose(number), T_map_camera)
        limits = self._config
        too_far = distance > MOTION_SLACK_M + limits.max_speed_m_s * elapsed_s
        turn = np.deg2rad(limits.max_turn_deg_s) * elapsed_s
        if too_far or angle > MOTION_SLACK_RAD + turn:
            motion = f"{distance:.2f} m and {np.rad2deg(angle):.0f} deg"
            return f"impossible motion: {motion} in {elapsed_s:.2f} s"
        return ""

    def _conflict(self, prior: PosePrior, T_map_camera: Pose) -> str:
        """How the map contradicts odometry."""
        distance, angle = _motion(prior.T_map_camera, T_map_camera)
        limits = self._config
        if distance > limits.max_conflict_m or angle > np.deg2rad(limits.max_conflict_deg):
            apart = f"{distance * 100:.0f} cm and {np.rad2deg(angle):.0f} deg"
            return f"the map has the camera {apart} from where odometry has it"
        return ""

    def _doubt(self, region: Region, rays: Rays, alignment: Alignment, witness: Witness) -> str:
        """Why the map alone does not tell enough; where there never was odometry it has to."""
        limits = self._config
        if not self._has_odometry:
            return ""
        if alignment.inlier_ratio < limits.doubted_inlier_ratio:
            share = f"{alignment.inlier_ratio:.0%}"
            return f"only {share} of the points lie on the map, and odometry has failed"
        likeness = colour_likeness(region, rays, alignment.T_map_camera)
        if likeness is not None and likeness < limits.doubted_colour_likeness:
            return "the map has other colours here, and odometry has failed"
        if witness(alignment.T_map_camera) is False:
            return "no keyframe nearby looks like this, and odometry has failed"
        return ""


def _motion(first: Pose, second: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (4, 4)."""
    apart = inverse(first) @ second
    return float(np.linalg.norm(apart[:3, 3])), rotation_angle(apart)
