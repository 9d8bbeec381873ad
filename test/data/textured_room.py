"""A furnished box of a room with a pattern on every surface, ray-traced exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import T_BODY_OPTICAL, PinholeCamera
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, exp

CAMERA = PinholeCamera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
ROOM_LOW, ROOM_HIGH = np.array([-0.7, -1.3, -0.9]), np.array([2.1, 1.3, 1.1])
BOXES = (
    (np.array([1.2, -0.9, -0.9]), np.array([1.7, -0.3, -0.2])),
    (np.array([1.5, 0.3, -0.9]), np.array([2.1, 1.0, 0.2])),
)
BALLS = ((np.array([1.3, 0.0, -0.55]), 0.35), (np.array([1.6, -0.5, 0.5]), 0.2))
PERIOD_NS = 66_666_667


def frame_at(
    T_map_camera: Pose, number: int = 0, camera: PinholeCamera = CAMERA, offset_m: float = 0.0
) -> RgbdFrame:
    """The exact view from a pose inside the room.

    Args:
        T_map_camera: (4, 4).
        number: of the frame; gives its stamp.
        camera: to look with.
        offset_m: added to all depths [m], a sensor's error.
    """
    directions = camera.pixel_directions().reshape(-1, 3).astype(np.float64)
    along = _cast(T_map_camera[:3, 3], directions @ T_map_camera[:3, :3].T)
    points = T_map_camera[:3, 3] + along[:, None] * (directions @ T_map_camera[:3, :3].T)
    size = (camera.height, camera.width)
    return RgbdFrame(
        stamp_ns=number * PERIOD_NS,
        color=np.round(255 * pattern(points)).astype(np.uint8).reshape(*size, 3),
        depth_m=(along + offset_m).astype(np.float32).reshape(size),
        camera=camera,
    )


def path(count: int, step_m: float = 0.01, step_deg: float = 0.6) -> list[Pose]:
    """Poses of a camera that starts at the origin, looks along x, drifts aside and turns."""
    twist = np.array([0.3, -1.0, 0.2, 0.1, 0.2, 1.0])
    twist[:3] *= step_m / np.linalg.norm(twist[:3])
    twist[3:] *= np.deg2rad(step_deg) / np.linalg.norm(twist[3:])
    return [exp(number * twist) @ T_BODY_OPTICAL for number in range(count)]


def pattern(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """RGB (N, 3) in [0, 1]: waves of several lengths, so that every patch is distinct."""
    waves = np.array([[9.0, 5.0, 7.0], [-6.0, 11.0, 4.0], [5.0, -4.0, 12.0], [17.0, 15.0, -14.0]])
    phases = np.sin(points @ waves.T + np.array([0.3, 1.7, 4.1, 2.2]))
    mix = np.array([[0.5, 0.1, 0.2, 0.2], [0.1, 0.5, 0.2, 0.2], [0.2, 0.2, 0.4, 0.2]])
    return 0.5 + 0.45 * phases @ mix.T


def surface_distance_m(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Unsigned distance (N,) of points (N, 3) inside the room to the nearest surface [m]."""
    distances = [np.minimum(points - ROOM_LOW, ROOM_HIGH - points).min(axis=1)]
    for low, high in BOXES:
        outside = np.maximum(np.maximum(low - points, points - high), 0.0)
        depth = np.maximum(np.minimum(points - low, high - points).min(axis=1), 0.0)
        distances.append(np.linalg.norm(outside, axis=1) + depth)
    distances += [np.linalg.norm(points - center, axis=1) - radius for center, radius in BALLS]
    return np.abs(distances).min(axis=0)


def _cast(origin: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiples (N,) of the directions (N, 3) at which rays meet the first surface."""
    directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    far = np.maximum((ROOM_LOW - origin) / directions, (ROOM_HIGH - origin) / directions)
    nearest = far.min(axis=1)
    for low, high in BOXES:
        sides = np.stack([(low - origin) / directions, (high - origin) / directions])
        enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    for center, radius in BALLS:
        a = np.einsum("ij,ij->i", directions, directions)
        b = directions @ (origin - center)
        c = np.dot(origin - center, origin - center) - radius**2
        root = b * b - a * c
        hit = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        nearest = np.where((root > 0) & (hit > 0), np.minimum(nearest, hit), nearest)
    return nearest
