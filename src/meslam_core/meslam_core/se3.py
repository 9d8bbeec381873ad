"""Rigid motions: exponential, logarithm and interpolation, for numpy and for torch.

A twist is (v, w): translation part [m] first, rotation part [rad] second, as in
Barfoot, *State Estimation for Robotics*, Sec. 7.1. `exp(twist) @ T` moves T in the outer frame.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import torch

Pose = NDArray[np.float64]

# Below this angle [rad] the first terms of a series are exact to double precision.
SMALL_ANGLE = 1e-4
# Up to this deviation of R^T R from the identity three terms repair R to double precision.
NEARLY_ORTHONORMAL = 1e-5
_IDENTITY = np.eye(3)


def hat(w: NDArray[np.floating]) -> NDArray[np.float64]:
    """Skew-symmetric matrix of a 3-vector: hat(w) @ x == cross(w, x)."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _sines(angle: float) -> tuple[float, float, float]:
    """sin(a) / a, (1 - cos(a)) / a^2 and (a - sin(a)) / a^3, also where a is small."""
    squared = angle * angle
    if angle < SMALL_ANGLE:
        return 1.0 - squared / 6.0, 0.5 - squared / 24.0, 1.0 / 6.0 - squared / 120.0
    sine = math.sin(angle)
    # Twice the squared sine of half the angle: 1 - cos(a) would cancel.
    half = math.sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / squared, (angle - sine) / (squared * angle)


def exp(twist: NDArray[np.floating]) -> Pose:
    """Pose (4, 4) of a twist (6,) (Barfoot, Eq. 7.77 and 7.86)."""
    twist = np.asarray(twist, np.float64)
    skew = hat(twist[3:])
    squared = skew @ skew
    a, b, c = _sines(math.hypot(*twist[3:].tolist()))
    pose = np.eye(4)
    pose[:3, :3] += a * skew + b * squared
    pose[:3, 3] = (_IDENTITY + b * skew + c * squared) @ twist[:3]
    return pose


def log(pose: Pose) -> NDArray[np.float64]:
    """Twist (6,) of a pose (4, 4); the rotation angle lies in [0, pi]."""
    w = rotation_vector(pose[:3, :3])
    angle = math.hypot(*w.tolist())
    factor = 1.0 / 12.0 + angle * angle / 720.0
    if angle >= SMALL_ANGLE:
        half = 0.5 * angle
        factor = (1.0 - half * math.cos(half) / math.sin(half)) / (angle * angle)
    skew = hat(w)
    translation = (_IDENTITY - 0.5 * skew + factor * (skew @ skew)) @ pose[:3, 3]
    return np.concatenate([translation, w])


def rotation_vector(rotation: NDArray[np.floating]) -> NDArray[np.float64]:
    """Axis times angle [rad] (3,) of a rotation matrix (3, 3); the angle lies in [0, pi]."""
    x, y, z, w = _quaternion(rotation)
    sine = math.hypot(x, y, z)
    # Of the two quaternions of a rotation the one with w >= 0 has the smaller angle.
    angle = 2.0 * math.atan2(sine, abs(w))
    factor = angle / sine if sine > 0.0 else 2.0
    return np.array([x, y, z]) * math.copysign(factor, w)


def _quaternion(rotation: NDArray[np.floating]) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w), by its largest component (Shepperd 1978)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rotation).tolist()
    trace = xx + yy + zz
    largest = max(trace, xx, yy, zz)
    if largest == trace:
        q = (zy - yz, xz - zx, yx - xy, 1.0 + trace)
    elif largest == xx:
        q = (1.0 + 2.0 * xx - trace, xy + yx, xz + zx, zy - yz)
    elif largest == yy:
        q = (xy + yx, 1.0 + 2.0 * yy - trace, yz + zy, xz - zx)
    else:
        q = (xz + zx, yz + zy, 1.0 + 2.0 * zz - trace, yx - xy)
    scale = 1.0 / math.hypot(*q)
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


def inverse(pose: Pose) -> Pose:
    """Inverse of a rigid pose (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


def adjoint(pose: Pose) -> NDArray[np.float64]:
    """Adjoint (6, 6) of a pose: pose @ exp(x) == exp(adjoint(pose) @ x) @ pose."""
    rotation, translation = pose[:3, :3], pose[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = rotation
    result[3:, 3:] = rotation
    result[:3, 3:] = hat(translation) @ rotation
    return result


def orthonormalized(pose: Pose) -> Pose:
    """The closest rigid pose to a nearly rigid one; products of many poses need it."""
    result = np.eye(4)
    result[:3, 3] = pose[:3, 3]
    rotation = np.asarray(pose[:3, :3], np.float64)
    excess = rotation.T @ rotation - _IDENTITY
    if np.abs(excess).max() < NEARLY_ORTHONORMAL and _determinant(rotation) > 0.0:
        # The polar factor R (R^T R)^(-1/2), its square root as a series.
        result[:3, :3] = rotation @ (_IDENTITY - 0.5 * excess + 0.375 * (excess @ excess))
        return result
    u, _, vt = np.linalg.svd(rotation)
    result[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return result


def _determinant(matrix: NDArray[np.float64]) -> float:
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def interpolate(start: Pose, end: Pose, fraction: float) -> Pose:
    """The pose at `fraction` (0 start, 1 end) of the screw motion from start to end."""
    return start @ exp(fraction * log(inverse(start) @ end))


def rotation_angle(pose: Pose) -> float:
    """Angle [rad] of the rotation part."""
    x, y, z, w = _quaternion(pose[:3, :3])
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def from_quaternion(position: NDArray[np.floating], quaternion_xyzw: NDArray[np.floating]) -> Pose:
    """Pose (4, 4) from a position [m] and a unit quaternion (x, y, z, w)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    pose[:3, 3] = position
    return pose


def to_quaternion(pose: Pose) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of the rotation part."""
    return np.array(_quaternion(pose[:3, :3]))


def torch_exp(twists: torch.Tensor) -> torch.Tensor:
    """Differentiable poses (N, 4, 4) of twists (N, 6); exact at zero, where training starts."""
    # Whoever has tensors has paid for torch; nobody else needs it here.
    import torch

    v, w = twists[:, :3], twists[:, 3:]
    squared = (w * w).sum(-1, keepdim=True)[..., None]
    small = squared < 1e-8
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    a = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / safe)
    c = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / (safe * angle))
    zero = torch.zeros_like(w[:, 0])
    skew = torch.stack(
        [zero, -w[:, 2], w[:, 1], w[:, 2], zero, -w[:, 0], -w[:, 1], w[:, 0], zero], -1
    ).reshape(-1, 3, 3)
    skew_squared = skew @ skew
    identity = torch.eye(3, dtype=w.dtype, device=w.device)
    rotation = identity + a * skew + b * skew_squared
    translation = (identity + b * skew + c * skew_squared) @ v[..., None]
    top = torch.cat([rotation, translation], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=w.dtype, device=w.device)
    return torch.cat([top, bottom.expand(len(twists), 1, 4)], 1)
