"""Rigid motions: exponential, logarithm and interpolation, for numpy and for torch.

A twist is (v, w): translation part [m] first, rotation part [rad] second, as in
Barfoot, *State Estimation for Robotics*, Sec. 7.1. `exp(twist) @ T` moves T in the outer frame.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Pose = NDArray[np.float64]


def hat(w: NDArray[np.floating]) -> NDArray[np.float64]:
    """Skew-symmetric matrix of a 3-vector: hat(w) @ x == cross(w, x)."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _left_jacobian(w: NDArray[np.floating]) -> NDArray[np.float64]:
    """Left Jacobian of SO(3) (Barfoot, Eq. 7.77)."""
    angle = float(np.linalg.norm(w))
    skew = hat(w)
    a, b = 0.5, 1.0 / 6.0
    if angle >= 1e-5:
        a = (1.0 - np.cos(angle)) / angle**2
        b = (angle - np.sin(angle)) / angle**3
    jacobian: NDArray[np.float64] = np.eye(3) + a * skew + b * skew @ skew
    return jacobian


def exp(twist: NDArray[np.floating]) -> Pose:
    """Pose (4, 4) of a twist (6,)."""
    twist = np.asarray(twist, np.float64)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
    pose[:3, 3] = _left_jacobian(twist[3:]) @ twist[:3]
    return pose


def log(pose: Pose) -> NDArray[np.float64]:
    """Twist (6,) of a pose (4, 4); the rotation angle lies in [0, pi]."""
    w = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return np.concatenate([np.linalg.solve(_left_jacobian(w), pose[:3, 3]), w])


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
    u, _, vt = np.linalg.svd(pose[:3, :3])
    result[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    result[:3, 3] = pose[:3, 3]
    return result


def interpolate(start: Pose, end: Pose, fraction: float) -> Pose:
    """The pose at `fraction` (0 start, 1 end) of the screw motion from start to end."""
    return start @ exp(fraction * log(inverse(start) @ end))


def rotation_angle(pose: Pose) -> float:
    """Angle [rad] of the rotation part."""
    return float(Rotation.from_matrix(pose[:3, :3]).magnitude())


def from_quaternion(position: NDArray[np.floating], quaternion_xyzw: NDArray[np.floating]) -> Pose:
    """Pose (4, 4) from a position [m] and a unit quaternion (x, y, z, w)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    pose[:3, 3] = position
    return pose


def to_quaternion(pose: Pose) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) of the rotation part."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat()


def torch_exp(twists: torch.Tensor) -> torch.Tensor:
    """Differentiable poses (N, 4, 4) of twists (N, 6); exact at zero, where training starts."""
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
