"""The way a hand carries a camera: a smooth closed route, walked at an even pace, with tremor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from meslam_core.se3 import Pose

RAMP_S = 1.0
"""Time to get going and to come to rest [s]."""

TREMOR_HZ = (0.9, 2.3, 5.1)
TREMOR_M = (0.006, 0.002, 0.0005)
TREMOR_RAD = (0.008, 0.004, 0.0008)


@dataclass(frozen=True)
class Route:
    """A closed way of the camera through a scene.

    Attributes:
        anchors: (N, 5) x, y, z [m], yaw and pitch [rad]; yaw runs on over full turns, pitch is
            positive downwards. The last row leads back to the first.
        pace_m_s: speed along it; hand-held scanning is as slow as the default.
        most_hurry: how many times faster it may be walked to end where it began.
        spread: (5,) standard deviation of the rounds' differences, in the anchors' units.
    """

    anchors: NDArray[np.float64]
    pace_m_s: float = 0.31
    most_hurry: float = 1 / 0.6
    spread: tuple[float, float, float, float, float] = (0.05, 0.05, 0.04, 0.04, 0.03)

    @property
    def round_m(self) -> float:
        """Length of one round along the anchors [m]."""
        ring = np.concatenate([self.anchors[:, :3], self.anchors[:1, :3]])
        return float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum())

    @property
    def round_s(self) -> float:
        """Time that one round takes [s]."""
        return self.round_m / self.pace_m_s + RAMP_S


class HandheldPath:
    """A camera's pose as a smooth function of time.

    A path long enough for a whole round of the route makes whole rounds and ends where it began;
    a shorter one ends on the way. Every round differs a little, and so does every seed.

    Args:
        route: the way to go.
        duration_s: length of the path [s].
        seed: of the rounds' differences and of the tremor.
    """

    def __init__(self, route: Route, duration_s: float, seed: int) -> None:
        rng = np.random.default_rng((seed, 0x9A7))
        self._duration_s = max(duration_s, 1e-3)
        round_m = route.round_m
        walked = max(self._duration_s - RAMP_S, 0.5 * self._duration_s) * route.pace_m_s / round_m
        whole = round(walked)
        if whole >= route.most_hurry * walked:
            whole = int(walked)
        rounds = max(whole, 1)
        once = route.anchors
        turns = 2 * np.pi * round((once[-1, 3] - once[0, 3]) / (2 * np.pi))
        anchors = np.concatenate([np.add(once, (0, 0, 0, k * turns, 0)) for k in range(rounds)])
        jitter = rng.normal(size=anchors.shape) * route.spread
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


def looking_ahead(
    waypoints: NDArray[np.float64], *, ahead_m: float = 1.8, spacing_m: float = 1.0
) -> NDArray[np.float64]:
    """Anchors (N, 5) of someone who walks past waypoints and mostly looks where the way leads.

    Args:
        waypoints: (M, 3) x, y [m] and a glance to the left of the way [rad]; the last leads back
            to the first.
        ahead_m: distance along the way of the point that is looked at [m].
        spacing_m: distance between anchors [m].
    """
    ring = np.concatenate([waypoints, waypoints[:1]])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ring[:, :2], axis=0), axis=1))])
    spline = CubicSpline(along, ring, bc_type="periodic")
    total = along[-1]
    count = round(total / spacing_m)
    stations = np.arange(count) * (total / count)
    x, y, glance = spline(stations).T
    aim = spline((stations + ahead_m) % total)[:, :2]
    yaw = np.unwrap(np.arctan2(aim[:, 1] - y, aim[:, 0] - x)) + glance
    # The start is level; nods and the height of the hand come and go in whole periods.
    nods = 2 * np.pi * np.round(total / 9.0) * stations / total
    z = 1.40 + 0.08 * np.sin(2 * np.pi * np.round(total / 13.0) * stations / total)
    pitch = np.radians(8) * (1 - np.cos(nods))
    return np.stack([x, y, z, yaw, pitch], axis=1)
