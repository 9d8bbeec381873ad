"""Whether a pose that fits the map can be right: by odometry, by motion, by the colours there."""

from __future__ import annotations

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
# So many frames in a row are held against what is known after odometry failed, then every so many.
ASKED_AT_ONCE = 8
THEN_EVERY = 4
# Where more keyframes than these were taken adrift, they are worth more than the doubt: a path that
# is off by no more than this has drifted, and links with older keyframes will correct it.
FEW_KEYFRAMES = 3
DRIFT_M = 0.3
DRIFT_RAD = 0.25
NANOSECONDS = 1e-9


class Plausibility:
    """Checks what the map's surface alone does not tell, and how far the path can be believed.

    A floor fits a floor. As long as valid odometry leads from one believed pose to the next, the
    pose is where it is said to be within a few centimetres. From the first frame on that odometry
    could not follow, the camera is adrift: it may be anywhere, and what is mapped from there on
    fits itself. Only what was known before can tell then.

    Args:
        config: the limits.
        history: of all frames.

    Attributes:
        followed: whether valid odometry leads to the latest frame from the last believed pose.
        adrift_since: number of keyframes when odometry last failed; None where a pose has been
            confirmed by what was known before.
    """

    def __init__(self, config: TrackingConfig, history: FrameHistory) -> None:
        self.followed = False
        self.adrift_since: int | None = None
        self._config = config
        self._history = history
        self._linked = True
        self._has_odometry = False
        self._mapped_adrift = False
        self._asked = 0
        self._believed: tuple[int, int] | None = None

    @property
    def last_believed(self) -> Pose:
        """T_map_camera (4, 4) of the last frame that fits the map, as it is known now."""
        return self._history.pose(self._believed[0] if self._believed else 0)

    @property
    def doubted(self) -> bool:
        """Whether fitting the map is not enough; where there never was odometry it has to be."""
        adrift = self.adrift_since is not None
        return self._has_odometry and (adrift or not self.followed)

    def pass_by(self, odometry: OdometryEstimate | None) -> None:
        """Note a frame's odometry."""
        valid = odometry is not None and odometry.valid
        self._has_odometry = self._has_odometry or valid
        # Any two poses from elsewhere tell the motion between them, whatever was in between; after
        # a failure of registration the next one may begin at a frame that it knows no pose of.
        registered = odometry is None or odometry.noise is None
        if self._has_odometry and registered and not valid:
            self._linked = False
            if self.adrift_since is None:
                keyframes = self._history.keyframes
                self.adrift_since = len(keyframes) if keyframes is not None else 0
        self.followed = valid and self._linked

    def confirm(self, stamp_ns: int) -> None:
        """The frame that is going to be added to the history is where it is said to be."""
        self._linked, self._mapped_adrift, self._asked = True, False, 0
        self.adrift_since = None
        self._believed = len(self._history), stamp_ns

    def accept(self, stamp_ns: int) -> None:
        """The frame that is going to be added trains the map, though it may be elsewhere."""
        self._linked = True
        self._mapped_adrift = self._mapped_adrift or self.adrift_since is not None
        self._believed = len(self._history), stamp_ns

    def asks(self) -> bool:
        """Whether this frame is to be held against the keyframes from before the doubt."""
        self._asked += 1
        return self._asked <= ASKED_AT_ONCE or self._asked % THEN_EVERY == 0

    def drifted(self, distance_m: float, angle_rad: float) -> bool:
        """Whether a camera that is known to be so far off has drifted, and was not carried."""
        keyframes, since = self._history.keyframes, self.adrift_since
        if keyframes is None or since is None or len(keyframes) - since <= FEW_KEYFRAMES:
            return False
        return distance_m <= DRIFT_M and angle_rad <= DRIFT_RAD

    def impossible(self, stamp_ns: int, T_map_camera: Pose) -> str:
        """How the motion since the last believed frame exceeds what is possible; else empty."""
        if self._believed is None:
            return ""
        number, believed_ns = self._believed
        elapsed_s = max((stamp_ns - believed_ns) * NANOSECONDS, 0.0)
        distance, angle = motion_between(self._history.pose(number), T_map_camera)
        limits = self._config
        too_far = distance > MOTION_SLACK_M + limits.max_speed_m_s * elapsed_s
        turn = np.deg2rad(limits.max_turn_deg_s) * elapsed_s
        if too_far or angle > MOTION_SLACK_RAD + turn:
            motion = f"{distance:.2f} m and {np.rad2deg(angle):.0f} deg"
            return f"impossible motion: {motion} in {elapsed_s:.2f} s"
        return ""

    def conflict(self, prior: PosePrior, T_map_camera: Pose) -> str:
        """How the map contradicts odometry that leads here; empty where it does not."""
        if not self.followed:
            return ""
        distance, angle = motion_between(prior.T_map_camera, T_map_camera)
        limits = self._config
        if distance > limits.max_conflict_m or angle > np.deg2rad(limits.max_conflict_deg):
            apart = f"{distance * 100:.0f} cm and {np.rad2deg(angle):.0f} deg"
            return f"the map has the camera {apart} from where odometry has it"
        return ""

    def certain(self, region: Region, rays: Rays, alignment: Alignment) -> bool:
        """Whether the map alone tells for certain, as long as nothing was mapped adrift."""
        limits = self._config
        if self._mapped_adrift or alignment.inlier_ratio < limits.certain_inlier_ratio:
            return False
        likeness = colour_likeness(region, rays, alignment.T_map_camera)
        return likeness is not None and likeness >= limits.certain_colour_likeness

    def unlikely(self, region: Region, rays: Rays, alignment: Alignment) -> str:
        """Why a pose that odometry does not lead to cannot even be a guess; else empty."""
        limits = self._config
        if self.followed:
            return ""
        if alignment.inlier_ratio < limits.doubted_inlier_ratio:
            share = f"{alignment.inlier_ratio:.0%}"
            return f"only {share} of the points lie on the map, and odometry has failed"
        likeness = colour_likeness(region, rays, alignment.T_map_camera)
        if likeness is not None and likeness < limits.doubted_colour_likeness:
            return "the map has other colours here, and odometry has failed"
        return ""


def motion_between(first: Pose, second: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (4, 4)."""
    apart = inverse(first) @ second
    return float(np.linalg.norm(apart[:3, 3])), rotation_angle(apart)
