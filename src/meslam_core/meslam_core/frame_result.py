"""What is known of a frame when it has been processed."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.joint_optimizer import StepLosses
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import Pose


class TrackingState(enum.IntEnum):
    """How far the latest pose can be trusted."""

    INITIALISING = 0
    OK = 1
    DEGRADED = 2
    LOST = 3
    RELOCALISING = 4


@dataclass(frozen=True)
class FrameResult:
    """What is known of a frame when its processing ends.

    Attributes:
        stamp_ns: of the image [ns].
        T_map_camera: (4, 4) online pose.
        covariance: (6, 6) of (translation [m], rotation [rad]) about the camera, map axes: how far
            the pose may be off in the frame of the map's first pose, drift included.
        state, reason: of tracking.
        odometry: estimate it started from, if there was one.
        residual_m: median distance of the frame's points to the mapped surface [m].
        inlier_ratio: share of points near the surface.
        is_keyframe: whether the frame became a keyframe.
        tracking_ms: time until the pose was known.
        losses: of the training that ended last: on this frame where mapping does not run beside
            tracking, and else on the one before.
        mapping_ms: time that training took.
    """

    stamp_ns: int
    T_map_camera: Pose
    covariance: NDArray[np.float64]
    state: TrackingState
    reason: str
    odometry: OdometryEstimate | None
    residual_m: float
    inlier_ratio: float
    tracking_ms: float
    is_keyframe: bool = False
    losses: StepLosses = field(default_factory=StepLosses)
    mapping_ms: float = 0.0
