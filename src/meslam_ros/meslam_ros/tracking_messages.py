"""What tracking knows of a frame, as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import Header

from meslam_core import se3
from meslam_core.frame_result import FrameResult, TrackingState
from meslam_core.trajectory import Trajectory
from meslam_interfaces.msg import TrackingStatus
from meslam_ros.conversions import to_pose, to_poses, to_stamp
from meslam_ros.diagnostics import ERROR, OK, STALE, WARN

LEVELS = {TrackingState.OK: OK, TrackingState.LOST: ERROR}


def header(stamp_ns: int, frame_id: str) -> Header:
    """A header of an image's stamp [ns]."""
    return Header(stamp=to_stamp(stamp_ns), frame_id=frame_id)


def pose_message(T_map_base: se3.Pose, head: Header) -> PoseStamped:
    """A stamped pose."""
    return PoseStamped(header=head, pose=to_pose(T_map_base))


def covariance_message(
    T_map_base: se3.Pose, covariance: NDArray[np.float64], T_map_camera: se3.Pose, head: Header
) -> PoseWithCovarianceStamped:
    """A stamped pose of the base with the covariance of the camera's pose carried over to it.

    Args:
        T_map_base: (4, 4) [m].
        covariance: (6, 6) of (translation [m], rotation [rad]) about the camera, map axes.
        T_map_camera: (4, 4) [m].
        head: stamp and frame.
    """
    transport = np.eye(6)
    transport[:3, 3:] = -se3.hat(T_map_base[:3, 3] - T_map_camera[:3, 3])
    message = PoseWithCovarianceStamped(header=head)
    message.pose.pose = to_pose(T_map_base)
    message.pose.covariance = np.ascontiguousarray(
        transport @ covariance @ transport.T, np.float64
    ).reshape(36)
    return message


def path_message(trajectory: Trajectory, T_camera_base: se3.Pose, frame_id: str) -> Path:
    """The base's path from the camera's trajectory."""
    poses = to_poses(trajectory.poses @ T_camera_base)
    path = Path(
        poses=[
            PoseStamped(header=header(int(stamp), frame_id), pose=pose)
            for stamp, pose in zip(trajectory.stamps_ns, poses, strict=True)
        ]
    )
    if path.poses:
        path.header = path.poses[-1].header
    return path


def health(result: FrameResult | None, dropped: str, overload: str = "") -> tuple[bytes, str]:
    """Level and sentence for /diagnostics.

    Args:
        result: of the latest frame; None before the first.
        dropped: images that were not used, with counts; empty when there were none.
        overload: why the computer is too slow; empty when it is not.
    """
    if result is None:
        return (ERROR, f"images were not used: {dropped}") if dropped else (STALE, "no images yet")
    level = LEVELS.get(result.state, WARN)
    if overload and level == OK:
        return WARN, f"{overload} ({dropped})"
    if dropped and level == OK:
        return WARN, f"images were not used: {dropped}"
    return level, result.reason or result.state.name


def status_message(result: FrameResult, head: Header) -> TrackingStatus:
    """What the result of one frame says; the node adds what it counts itself."""
    return TrackingStatus(
        header=head,
        state=int(result.state),
        reason=result.reason,
        residual_m=float(result.residual_m),
        inlier_ratio=float(result.inlier_ratio),
        odometry_valid=result.odometry is not None and result.odometry.valid,
        loss_distance=float(result.losses.distance),
        loss_depth=float(result.losses.depth),
        loss_color=float(result.losses.color),
        iterations=int(result.losses.steps),
        is_keyframe=bool(result.is_keyframe),
        tracking_ms=float(result.tracking_ms),
        mapping_ms=float(result.mapping_ms),
    )
