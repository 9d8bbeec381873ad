"""The way a hand carries a camera: a smooth closed route, walked at an even pace, with tremor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from meslam_core.se3 import Pose

SPEED_M_S = 0.31
"""Pace along the route; hand-held scanning is this slow."""

RAMP_S = 1.0
"""Time to get going and to come to rest [s]."""

TREMOR_HZ = (0.9, 2.3, 5.1)
TREMOR_M = (0.006, 0.002, 0.0005)
TREMOR_RAD = (0.008, 0.004, 0.0008)


class HandheldPath:
    """A camera's pose as a smooth function of time.

    A path long enough for a whole round of the route makes whole rounds and ends where it began;
    a shorter one ends on the way. Every round differs a little, and so does every seed.

    Args:
        route: (N, 5) closed way, see `Scene.route`.
        duration_s: length of the path [s].
        seed: of the rounds' differences and of the tremor.
    """

    def __init__(self, route: NDArray[np.float64], duration_s: float, seed: int) -> None:
        rng = np.random.default_rng((seed, 0x9A7))
        self._duration_s = max(duration_s, 1e-3)
        ring = np.concatenate([route[:, :3], route[:1, :3]])
        round_m = float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum())
        walked = max(self._duration_s - RAMP_S, 0.5 * self._duration_s) * SPEED_M_S / round_m
        whole = round(walked) if walked > 0.6 else 0
        rounds = max(whole, 1)
        turns = 2 * np.pi * round((route[-1, 3] - route[0, 3]) / (2 * np.pi))
        anchors = np.concatenate([np.add(route, (0, 0, 0, k * turns, 0)) for k in range(rounds)])
        jitter = rng.normal(size=anchors.shape) * (0.05, 0.05, 0.04, 0.04, 0.03)
        jitter[0] = 0
        anchors += jitter
        end = np.add(anchors[0], (0, 0, 0, rounds * turns, 0))
        knots = np.concatenate([anchors, end[None]])
        lengths = np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1)
        self._along = np.concatenate([[0], np.cumsum(lengths)])
        # The yaw's full turns are a slope on top of a periodic curve.
        self._slope = rounds * turns / self._along[-1]
        knots[:, 3] -= self._slope * self._along
        knots[-1] = knots[0]
        self._spline = CubicSpline(self._along, knots, bc_type="periodic")
        self._reach_m = self._along[-1] if whole else walked * round_m
        self._phases = rng.uniform(0, 2 * np.pi, (6, len(TREMOR_HZ)))

    def pose(self, time_s: float) -> Pose:
        """T_map_camera (4, 4) at a time since the start [s], optical axes."""
        distance = self._reach_m * self._progress(time_s)
        x, y, z, yaw, pitch = self._spline(distance)
        yaw += self._slope * distance
        shake = np.sin(2 * np.pi * np.array(TREMOR_HZ) * time_s + self._phases)
        position = np.array([x, y, z]) + shake[:3] @ np.array(TREMOR_M)
        tilt = shake[3:] @ np.array(TREMOR_RAD)
        yaw, pitch, roll = yaw + tilt[0], pitch + tilt[1], 1.5 * tilt[2]
        forward = np.array(
            [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
        )
        level = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        down = np.cross(forward, level)
        result = np.eye(4)
        result[:3, 0] = np.cos(roll) * level + np.sin(roll) * down
        result[:3, 1] = np.cos(roll) * down - np.sin(roll) * level
        result[:3, 2] = forward
        result[:3, 3] = position
        return result

    def _progress(self, time_s: float) -> float:
        """Share of the way done: speed rises over a ramp, stays, and falls again."""
        total = self._duration_s
        ramp = min(RAMP_S, total / 2)
        done = _eased(time_s / ramp) * ramp - _eased((time_s - total + ramp) / ramp) * ramp
        return float(done / (total - ramp))


def _eased(x: float) -> float:
    """Integral of a speed that rises smoothly from 0 at x = 0 to 1 at x = 1 and stays."""
    if x <= 0:
        return 0.0
    inside = min(x, 1.0)
    return inside**3 - 0.5 * inside**4 + (x - inside)
