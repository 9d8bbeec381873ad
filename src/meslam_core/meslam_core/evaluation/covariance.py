"""Whether a pose's covariance tells the truth about its error.

The error of a pose is the one in the map's frame, which is that of the first pose: there it is
zero, and it grows with drift. The truth is therefore laid over the first second of the estimate,
and those frames do not count. Laid over the whole trajectory, as for the ATE, the errors are
smaller, and smallest in the middle: what drifted one way is then taken for an error of the frame.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from meslam_core.errors import EvaluationError
from meslam_core.evaluation.alignment import rigid_alignment, solve_hand_eye
from meslam_core.evaluation.clock import at_stamps, clock_offset_s
from meslam_core.se3 import Pose, inverse
from meslam_core.trajectory import NANOSECONDS, Trajectory

Floats = NDArray[np.float64]

# The truth's first pose alone would hand its own noise to all frames.
ORIGIN_S = 1.0
CONFIDENCE = 0.95


@dataclass(frozen=True)
class PoseErrors:
    """How far poses are off, in the map's axes.

    Attributes:
        frames: (N,) indices into the estimate.
        path_m: (N,) length of the true path up to each [m].
        shifts_m: (N, 3) of the positions [m].
        turns_rad: (N, 3) rotation vectors: the estimate is the truth turned by so much [rad].
        clock_offset_s: that was taken off the truth's stamps [s].
    """

    frames: NDArray[np.int64]
    path_m: Floats
    shifts_m: Floats
    turns_rad: Floats
    clock_offset_s: float


@dataclass(frozen=True)
class Calibration:
    """Errors of three axes against their covariances.

    Attributes:
        held: share of the frames whose error lies in the ellipsoid that should hold 95 %.
        nees: mean normalised squared error of an axis; 1 where covariances are right, larger
            where they are too small (Bar-Shalom et al., *Estimation with Applications to Tracking
            and Navigation*, Sec. 5.4).
        sigma_ratio: median of predicted deviation over error; 1.13 for Gaussian errors that are
            alike in all directions.
        error: root of the mean squared error [m or rad].
        predicted: the same as the covariances have it.
    """

    held: float
    nees: float
    sigma_ratio: float
    error: float
    predicted: float


def pose_errors(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    origin_s: float | None = ORIGIN_S,
    hand_eye: bool = False,
    fit_clock: bool = False,
) -> PoseErrors:
    """Errors of all poses that the truth covers.

    Args:
        estimate: T_map_camera as it was known when each frame was done.
        truth: T_truth_camera, or with `hand_eye` the poses of a sensor mounted on the camera; it is
            interpolated.
        origin_s: the truth is laid over the first so many seconds, position and rotation, and
            later frames are returned [s]; None lays it over all positions and returns all.
        hand_eye: also solve for the sensor's unknown mounting (see `solve_hand_eye`).
        fit_clock: the truth has a clock of its own (see `clock_offset_s`).

    Raises:
        EvaluationError: when too few poses are covered, or none after the first seconds.
    """
    offset_s = clock_offset_s(estimate, truth) if fit_clock else 0.0
    frames, true = at_stamps(truth, estimate.stamps_ns, offset_s)
    known = estimate.subset(frames)
    if hand_eye:
        T_camera_sensor = solve_hand_eye(known, true).T_camera_sensor
        true = true.transformed(np.eye(4), inverse(T_camera_sensor))
    begun = np.zeros(len(frames), bool)
    if origin_s is None:
        T_truth_map = rigid_alignment(known.positions, true.positions)
    else:
        begun = known.stamps_ns < known.stamps_ns[0] + round(origin_s * NANOSECONDS)
        T_truth_map = _mean_alignment(known.poses[begun], true.poses[begun])
        if begun.all():
            raise EvaluationError(
                f"the trajectory ends within the first {origin_s:g} s, which fix the frame"
            )
    true = true.transformed(inverse(T_truth_map))
    turned = known.rotations @ true.rotations.transpose(0, 2, 1)
    steps = np.linalg.norm(np.diff(true.positions, axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    return PoseErrors(
        frames[~begun],
        path_m[~begun],
        (known.positions - true.positions)[~begun],
        Rotation.from_matrix(turned).as_rotvec()[~begun],
        offset_s,
    )


def calibration(errors: Floats, covariances: Floats) -> Calibration:
    """Compare errors (N, 3) with their covariances (N, 3, 3), which must be positive definite.

    Raises:
        EvaluationError: when shapes differ, there is no error or a covariance is none.
    """
    if not len(errors) or covariances.shape != (len(errors), 3, 3):
        raise EvaluationError(
            f"errors {errors.shape} and covariances {covariances.shape}; expected (N, 3) and "
            "(N, 3, 3)"
        )
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(covariances), errors[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError as error:
        raise EvaluationError("a covariance is not positive definite") from error
    squared = np.square(whitened).sum(axis=1)
    lengths = np.linalg.norm(errors, axis=1)
    predicted = np.trace(covariances, axis1=1, axis2=2)
    ratios = np.sqrt(predicted) / np.maximum(lengths, np.finfo(float).tiny)
    return Calibration(
        held=float(np.mean(squared <= chi2.ppf(CONFIDENCE, 3))),
        nees=float(squared.mean() / 3.0),
        sigma_ratio=float(np.median(ratios)),
        error=float(np.sqrt(np.mean(np.square(lengths)))),
        predicted=float(np.sqrt(predicted.mean())),
    )


def covariance_entries(
    online: Trajectory, covariances: Floats, truth: Trajectory, *, hand_eye: bool = False
) -> dict[str, float | None]:
    """What `meslam run --truth` adds to report.json about the covariances of the live poses.

    `covariance_*_held` and `covariance_*_nees` of `Calibration` for position and rotation; None
    when the trajectory is too short for them.

    Args:
        online: T_map_camera.
        covariances: (N, 6, 6) of (translation [m], rotation [rad]), map axes, one a pose.
        truth, hand_eye: as in `pose_errors`.
    """
    position, rotation = None, None
    with suppress(EvaluationError):
        errors = pose_errors(online, truth, hand_eye=hand_eye)
        chosen = covariances[errors.frames]
        position = calibration(errors.shifts_m, chosen[:, :3, :3])
        rotation = calibration(errors.turns_rad, chosen[:, 3:, 3:])
    entries: dict[str, float | None] = {}
    for name, found in (("position", position), ("rotation", rotation)):
        entries[f"covariance_{name}_held"] = found.held if found else None
        entries[f"covariance_{name}_nees"] = found.nees if found else None
    return entries


def _mean_alignment(poses: Floats, true_poses: Floats) -> Pose:
    """T_truth_map (4, 4) in the mean over some poses (N, 4, 4)."""
    turns = true_poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    result = np.eye(4)
    result[:3, :3] = Rotation.from_matrix(turns).mean().as_matrix()
    moved = poses[:, :3, 3] @ result[:3, :3].T
    result[:3, 3] = (true_poses[:, :3, 3] - moved).mean(axis=0)
    return result
