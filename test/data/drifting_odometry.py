"""Odometry as wheels give it: true motions, each a little wrong in the same way."""

from __future__ import annotations

import numpy as np

from meslam_core.se3 import exp, inverse
from meslam_core.trajectory import Trajectory

START = exp(np.array([3.0, -2.0, 0.5, 0.3, -0.2, 1.1]))


def drifting(
    truth: Trajectory,
    share: float = 0.02,
    deg_m: float = 1.0,
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Trajectory:
    """True poses of a camera with drift, in a frame of their own.

    Args:
        truth: T_map_camera.
        share: by which every step is too long.
        deg_m: by which a metre of the way turns the camera too far [deg/m].
        axis: of that turn, camera frame; by default the image's vertical.
    """
    turn_axis = np.deg2rad(deg_m) * np.asarray(axis) / np.linalg.norm(axis)
    poses = [START]
    for before, after in zip(truth.poses[:-1], truth.poses[1:], strict=True):
        motion = inverse(before) @ after
        distance = np.linalg.norm(motion[:3, 3])
        motion[:3, 3] *= 1.0 + share
        poses.append(poses[-1] @ motion @ exp(np.concatenate([np.zeros(3), distance * turn_axis])))
    return Trajectory(truth.stamps_ns, np.array(poses))
