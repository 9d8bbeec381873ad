"""Bringing an estimated and a true trajectory together: stamps, rigid motion, lever arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from meslam_core import se3
from meslam_core.errors import EvaluationError
from meslam_core.se3 import Pose
from meslam_core.trajectory import NANOSECONDS, Trajectory

ASSOCIATION_TOLERANCE_S = 0.02
"""Largest difference between the stamps of a pair [s], the TUM benchmark's."""

ROTATION_LEVER_M = 0.1
"""Length that makes an angle comparable to a distance in the hand-eye fit [m/rad]."""


def associate(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float = ASSOCIATION_TOLERANCE_S
) -> tuple[Trajectory, Trajectory]:
    """Pair the poses whose stamps are nearest, each pose at most once, as the TUM benchmark does.

    Returns:
        The paired poses of both trajectories, equally long, in the order of time.

    Raises:
        EvaluationError: when fewer than three pairs exist.
    """
    tolerance_ns = round(tolerance_s * NANOSECONDS)
    first = np.searchsorted(truth.stamps_ns, estimate.stamps_ns - tolerance_ns, side="left")
    last = np.searchsorted(truth.stamps_ns, estimate.stamps_ns + tolerance_ns, side="right")
    candidates = [
        (abs(int(estimate.stamps_ns[i] - truth.stamps_ns[j])), i, j)
        for i in range(len(estimate))
        for j in range(first[i], last[i])
    ]
    used_estimate, used_truth, pairs = set(), set(), []
    for _, i, j in sorted(candidates):
        if i not in used_estimate and j not in used_truth:
            used_estimate.add(i)
            used_truth.add(j)
            pairs.append((i, j))
    if len(pairs) < 3:
        raise EvaluationError(
            f"only {len(pairs)} poses of the estimate ({_span(estimate)}) have a true pose "
            f"({_span(truth)}) within {tolerance_s * 1e3:.0f} ms; at least 3 are needed: are both "
            "on the same clock?"
        )
    # Greedy pairs may cross in time only where two differences tie; order by the estimate.
    indices = np.array(sorted(pairs))
    return estimate.subset(indices[:, 0]), truth.subset(np.sort(indices[:, 1]))


def rigid_alignment(points: NDArray[np.floating], reference: NDArray[np.floating]) -> Pose:
    """The rigid motion that carries points (N, 3) onto reference (N, 3) in the least squares.

    Umeyama, *Least-squares estimation of transformation parameters*, 1991, without scale.

    Returns:
        (4, 4) T_reference_points.
    """
    center, reference_center = points.mean(axis=0), reference.mean(axis=0)
    covariance = (reference - reference_center).T @ (points - center)
    u, _, vt = np.linalg.svd(covariance)
    result = np.eye(4)
    result[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
    result[:3, 3] = reference_center - result[:3, :3] @ center
    return result


@dataclass(frozen=True)
class HandEye:
    """How the sensor that measured the truth rides on the camera.

    T_truth_sensor = T_truth_map @ T_map_camera @ T_camera_sensor.

    Attributes:
        T_truth_map: (4, 4) maps the estimate's map frame into the truth's frame.
        T_camera_sensor: (4, 4) pose of the true sensor in the camera.
    """

    T_truth_map: Pose
    T_camera_sensor: Pose

    @property
    def lever_arm_m(self) -> float:
        """Distance between camera and true sensor [m]."""
        return float(np.linalg.norm(self.T_camera_sensor[:3, 3]))


def solve_hand_eye(estimate: Trajectory, truth: Trajectory) -> HandEye:
    """Find the mounting of the sensor that measured the truth together with the alignment.

    Starts from the closed form (rotation from the relative rotations' axes as in Park and Martin,
    *Robot sensor calibration: solving AX = XB on the Euclidean group*, 1994; lever arm by linear
    least squares) and minimises position errors and, weighted by ROTATION_LEVER_M, angles.

    Args:
        estimate, truth: associated trajectories of equal length (see `associate`).

    Raises:
        EvaluationError: when the motion turns too little to tell how the sensor is mounted.
    """
    start = _closed_form(estimate, truth)
    initial = np.concatenate([se3.log(start.T_truth_map), se3.log(start.T_camera_sensor)])

    def moved(parameters: NDArray[np.float64]) -> tuple[Pose, Pose]:
        return se3.exp(parameters[:6]), se3.exp(parameters[6:])

    def residuals(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        T_truth_map, T_camera_sensor = moved(parameters)
        predicted = T_truth_map @ estimate.poses @ T_camera_sensor
        turned = truth.rotations.transpose(0, 2, 1) @ predicted[:, :3, :3]
        angles = Rotation.from_matrix(turned).as_rotvec()
        shifts = predicted[:, :3, 3] - truth.positions
        return np.concatenate([shifts.ravel(), ROTATION_LEVER_M * angles.ravel()])

    solution = least_squares(residuals, initial, x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-14)
    return HandEye(*moved(solution.x))


def _closed_form(estimate: Trajectory, truth: Trajectory) -> HandEye:
    """Hand-eye calibration from relative rotations, then a linear fit of both translations."""
    # Long steps turn far enough for their axes to be sharp; every step shares the mounting.
    step = max(1, len(estimate) // 10)
    turned_camera = _relative_rotation_vectors(estimate.rotations, step)
    turned_sensor = _relative_rotation_vectors(truth.rotations, step)
    u, singular, vt = np.linalg.svd(turned_camera.T @ turned_sensor)
    spread = np.sqrt(singular[1] / len(turned_camera))
    if spread < np.radians(0.5):
        raise EvaluationError(
            "the trajectory hardly turns about two axes "
            f"({np.degrees(spread):.2f} deg), so the offset of the sensor that measured the truth "
            "cannot be found; compare without the hand-eye fit"
        )
    R_camera_sensor = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    products = truth.rotations @ R_camera_sensor.T @ estimate.rotations.transpose(0, 2, 1)
    R_truth_map = Rotation.from_matrix(products).mean().as_matrix()
    design = np.concatenate(
        [R_truth_map @ estimate.rotations, np.tile(np.eye(3), (len(truth), 1, 1))], 2
    )
    target = truth.positions - estimate.positions @ R_truth_map.T
    translations, *_ = np.linalg.lstsq(design.reshape(-1, 6), target.ravel(), rcond=None)
    T_truth_map, T_camera_sensor = np.eye(4), np.eye(4)
    T_truth_map[:3, :3], T_truth_map[:3, 3] = R_truth_map, translations[3:]
    T_camera_sensor[:3, :3], T_camera_sensor[:3, 3] = R_camera_sensor, translations[:3]
    return HandEye(T_truth_map, T_camera_sensor)


def _relative_rotation_vectors(rotations: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """Rotation vectors (N - step, 3) of rotations[i]^T rotations[i + step]."""
    relative = rotations[:-step].transpose(0, 2, 1) @ rotations[step:]
    return Rotation.from_matrix(relative).as_rotvec()


def _span(trajectory: Trajectory) -> str:
    """Number of poses and their first and last stamp, for messages."""
    if not len(trajectory):
        return "0 poses"
    seconds = trajectory.stamps_ns[[0, -1]] / NANOSECONDS
    return f"{len(trajectory)} poses from {seconds[0]:.3f} to {seconds[1]:.3f} s"
