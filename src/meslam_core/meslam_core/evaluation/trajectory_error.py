"""How far an estimated trajectory is from the true one: absolute, relative, frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meslam_core.errors import EvaluationError
from meslam_core.evaluation.alignment import (
    ASSOCIATION_TOLERANCE_S,
    HandEye,
    associate,
    rigid_alignment,
    solve_hand_eye,
)
from meslam_core.trajectory import NANOSECONDS, Trajectory


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error (ATE) of Sturm et al., *A benchmark for RGB-D SLAM*, 2012.

    Attributes:
        estimate: the compared poses, moved into the truth's frame.
        truth: the true poses paired with them.
        errors_m: (N,) distance of every pair [m].
        mounting: the alignment that was applied; T_camera_sensor is the identity unless a
            hand-eye fit was asked for.
    """

    estimate: Trajectory
    truth: Trajectory
    errors_m: NDArray[np.float64]
    mounting: HandEye

    @property
    def rmse_m(self) -> float:
        """Root mean square [m]."""
        return _rmse(self.errors_m)

    @property
    def median_m(self) -> float:
        """Median [m]."""
        return float(np.median(self.errors_m))

    @property
    def max_m(self) -> float:
        """Largest error [m]."""
        return float(self.errors_m.max())


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error (RPE) of Sturm et al. 2012 over one fixed step.

    Attributes:
        translations_m: (N,) translational error of each step [m].
        rotations_deg: (N,) rotational error of each step [deg].
    """

    translations_m: NDArray[np.float64]
    rotations_deg: NDArray[np.float64]

    @property
    def trans_rmse_m(self) -> float:
        """Root mean square of the translational errors [m]."""
        return _rmse(self.translations_m)

    @property
    def rot_rmse_deg(self) -> float:
        """Root mean square of the rotational errors [deg]."""
        return _rmse(self.rotations_deg)


def absolute_error(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
    hand_eye: bool = False,
) -> AbsoluteError:
    """ATE after association by stamp and rigid alignment.

    Args:
        estimate: T_map_camera.
        truth: T_truth_camera, or with `hand_eye` the poses of a sensor mounted on the camera.
        tolerance_s: largest difference of stamps in a pair [s].
        hand_eye: also solve for the sensor's unknown mounting (see `solve_hand_eye`).

    Raises:
        EvaluationError: when fewer than three poses can be paired, or `hand_eye` lacks rotation.
    """
    paired, paired_truth = associate(estimate, truth, tolerance_s)
    if hand_eye:
        mounting = solve_hand_eye(paired, paired_truth)
    else:
        alignment = rigid_alignment(paired.positions, paired_truth.positions)
        mounting = HandEye(alignment, np.eye(4))
    aligned = paired.transformed(mounting.T_truth_map, mounting.T_camera_sensor)
    errors = np.linalg.norm(aligned.positions - paired_truth.positions, axis=1)
    return AbsoluteError(aligned, paired_truth, errors, mounting)


def relative_error_by_frames(
    estimate: Trajectory,
    truth: Trajectory,
    delta: int = 1,
    *,
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
) -> RelativeError:
    """RPE between each paired pose and the one `delta` pairs later.

    Raises:
        EvaluationError: when there are not more than `delta` pairs.
    """
    paired, paired_truth = associate(estimate, truth, tolerance_s)
    first = np.arange(len(paired) - delta)
    return _relative_error(paired, paired_truth, first, first + delta, f"{delta} frames")


def relative_error_by_time(
    estimate: Trajectory,
    truth: Trajectory,
    delta_s: float = 1.0,
    *,
    tolerance_s: float = ASSOCIATION_TOLERANCE_S,
) -> RelativeError:
    """RPE between each paired pose and the one nearest to `delta_s` later.

    A step counts when its length is within half a median frame interval of `delta_s`.

    Raises:
        EvaluationError: when the trajectory is shorter than `delta_s`.
    """
    paired, paired_truth = associate(estimate, truth, tolerance_s)
    stamps, delta_ns = paired.stamps_ns, round(delta_s * NANOSECONDS)
    after = np.clip(np.searchsorted(stamps, stamps + delta_ns), 1, len(stamps) - 1)
    before_is_nearer = stamps + delta_ns - stamps[after - 1] < stamps[after] - stamps - delta_ns
    second = after - before_is_nearer
    deviation = np.abs(stamps[second] - stamps - delta_ns)
    first = np.flatnonzero(
        (deviation <= 0.5 * np.median(np.diff(stamps))) & (second > np.arange(len(stamps)))
    )
    return _relative_error(paired, paired_truth, first, second[first], f"{delta_s:g} s")


def frame_jitter_m(
    online: Trajectory, truth: Trajectory, *, tolerance_s: float = ASSOCIATION_TOLERANCE_S
) -> float:
    """RMSE of the motion from each frame to the next [m]: how much a live pose trembles.

    Steps over frames that were not tracked do not count.

    Raises:
        EvaluationError: when no two consecutive frames can be paired.
    """
    paired, paired_truth = associate(online, truth, tolerance_s)
    steps = np.diff(paired.stamps_ns)
    first = np.flatnonzero(steps < 1.5 * np.median(steps))
    return _relative_error(paired, paired_truth, first, first + 1, "one frame").trans_rmse_m


def _relative_error(
    estimate: Trajectory,
    truth: Trajectory,
    first: NDArray[np.integer],
    second: NDArray[np.integer],
    step: str,
) -> RelativeError:
    """Errors of the motions first -> second."""
    if not len(first):
        raise EvaluationError(
            f"{len(estimate)} paired poses over {estimate.duration_s:.2f} s hold no step of "
            f"{step}; compare longer trajectories"
        )
    motion = _inverse(estimate.poses[first]) @ estimate.poses[second]
    true_motion = _inverse(truth.poses[first]) @ truth.poses[second]
    error = _inverse(true_motion) @ motion
    angles = Rotation.from_matrix(error[:, :3, :3]).magnitude()
    return RelativeError(np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(angles))


def _inverse(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses of rigid poses (N, 4, 4)."""
    rotations = poses[:, :3, :3].transpose(0, 2, 1)
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = -(rotations @ poses[:, :3, 3:])[..., 0]
    return result


def _rmse(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
