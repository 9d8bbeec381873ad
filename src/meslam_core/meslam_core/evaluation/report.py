"""The entries of report.json that need the truth."""

from __future__ import annotations

import open3d as o3d

from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.alignment import ASSOCIATION_TOLERANCE_S
from meslam_core.evaluation.reconstruction import depth_error, observed_surface, surface_error
from meslam_core.evaluation.trajectory_error import (
    absolute_error,
    frame_jitter_m,
    relative_error_by_frames,
    relative_error_by_time,
)
from meslam_core.se3 import Pose
from meslam_core.trajectory import Trajectory


def trajectory_entries(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
    hand_eye: bool = False,
) -> dict[str, float | int | None]:
    """What `meslam evaluate` prints for one trajectory.

    `ate_*` [m] follow a rigid alignment; `rpe_trans_m` and `rpe_rot_deg` are RMSEs over one second
    as in the TUM benchmark (None when the trajectory is shorter), `rpe_frame_*` from frame to
    frame. With `hand_eye` the truth is another sensor's on the same mount, `lever_arm_m` is its
    fitted distance, and the relative errors are those of that sensor.

    Raises:
        EvaluationError: when the trajectories cannot be compared.
    """
    absolute = absolute_error(estimate, truth, tolerance_s=tolerance_s, hand_eye=hand_eye)
    frames = relative_error_by_frames(absolute.estimate, absolute.truth, tolerance_s=tolerance_s)
    entries: dict[str, float | int | None] = {
        "poses_compared": len(absolute.errors_m),
        "path_length_m": absolute.truth.length_m,
        "ate_rmse_m": absolute.rmse_m,
        "ate_median_m": absolute.median_m,
        "ate_max_m": absolute.max_m,
        "rpe_trans_m": None,
        "rpe_rot_deg": None,
        "rpe_frame_trans_m": frames.trans_rmse_m,
        "rpe_frame_rot_deg": frames.rot_rmse_deg,
    }
    try:
        second = relative_error_by_time(absolute.estimate, absolute.truth, tolerance_s=tolerance_s)
    except EvaluationError:
        pass
    else:
        entries["rpe_trans_m"] = second.trans_rmse_m
        entries["rpe_rot_deg"] = second.rot_rmse_deg
    if hand_eye:
        entries["lever_arm_m"] = absolute.mounting.lever_arm_m
    return entries


def truth_entries(
    refined: Trajectory,
    online: Trajectory,
    truth: Trajectory,
    *,
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
    hand_eye: bool = False,
) -> dict[str, float | int | None]:
    """What `meslam run --truth` adds to report.json.

    The entries of `trajectory_entries` for the refined trajectory, `ate_online_rmse_m` and
    `jitter_online_m` (frame-to-frame RMSE) for the poses as they were known live [m].

    Raises:
        EvaluationError: when the trajectories cannot be compared.
    """
    entries = trajectory_entries(refined, truth, tolerance_s=tolerance_s, hand_eye=hand_eye)
    live = absolute_error(online, truth, tolerance_s=tolerance_s, hand_eye=hand_eye)
    entries["ate_online_rmse_m"] = live.rmse_m
    entries["jitter_online_m"] = frame_jitter_m(live.estimate, live.truth, tolerance_s=tolerance_s)
    return entries


def surface_entries(
    reconstruction: o3d.geometry.TriangleMesh,
    surface: o3d.geometry.TriangleMesh,
    camera: PinholeCamera,
    truth: Trajectory,
    T_truth_map: Pose,
) -> dict[str, float]:
    """What a report says of a mesh where the true surface is known.

    Args:
        reconstruction: in the map's frame [m].
        surface: the exact surface in the truth's frame [m].
        camera: intrinsics of the recording.
        truth: T_truth_camera of the recording, to know what was observed.
        T_truth_map: (4, 4), such as the alignment of the trajectories (`AbsoluteError.mounting`).

    Returns:
        The fields of `SurfaceError` and, prefixed with `depth_`, of `DepthError`.

    Raises:
        EvaluationError: when a mesh is empty or nothing of the surface was observed.
    """
    observed = observed_surface(surface, camera, truth)
    error = surface_error(reconstruction, surface, observed, T_truth_map=T_truth_map)
    depth = depth_error(reconstruction, surface, camera, truth, T_truth_map=T_truth_map)
    return {**error.to_dict(), **depth.to_dict()}
