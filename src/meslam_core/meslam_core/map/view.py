"""A map as a camera would see it: the stored networks, rendered along the rays of its pixels."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.field.rendering import render
from meslam_core.map.neural_map import NeuralMap
from meslam_core.se3 import Pose

NEAREST_M = 0.1
# Coarse steps look for the first surface, fine ones are rendered about it.
COARSE_STEP_M = 0.03
FINE_SAMPLES = 24
BEHIND_M = 0.08
SLAB = 16
# So many rays at once stay in the processor's cache.
BATCH = 2048
# A ray of which less ends at a surface sees none.
MIN_OPACITY = 0.5
# Value of f where no surface was seen near: free space.
FREE = np.float32(-1.0)

Floats = NDArray[np.float32]


def render_view(
    neural_map: NeuralMap, camera: PinholeCamera, T_map_camera: Pose, far_m: float
) -> tuple[NDArray[np.uint8], Floats]:
    """The view from a pose (4, 4), by volume rendering of the blended field.

    Args:
        neural_map: to look at.
        camera: of the picture.
        T_map_camera: where from.
        far_m: surfaces farther along the optical axis are not looked for [m].

    Returns:
        (H, W, 3) uint8 RGB and (H, W) float32 depth along the optical axis [m], both 0 where the
        map shows no surface.
    """
    directions = camera.pixel_directions().reshape(-1, 3)
    turned = directions.astype(np.float64) @ T_map_camera[:3, :3].T
    origin = T_map_camera[:3, 3]
    color = np.zeros((len(directions), 3), np.uint8)
    depth_m = np.zeros(len(directions), np.float32)
    for start in range(0, len(turned), BATCH):
        batch = slice(start, start + BATCH)
        hit_m = _first_surface(neural_map, origin, turned[batch], far_m)
        rays = np.flatnonzero(np.isfinite(hit_m))
        if len(rays):
            seen, rgb, found_m = _rendered(neural_map, origin, turned[start + rays], hit_m[rays])
            color[start + rays[seen]] = np.clip(255.0 * rgb[seen] + 0.5, 0, 255).astype(np.uint8)
            depth_m[start + rays[seen]] = found_m[seen]
    size = (camera.height, camera.width)
    return color.reshape(*size, 3), depth_m.reshape(size)


def _first_surface(
    neural_map: NeuralMap,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    far_m: float,
) -> NDArray[np.float64]:
    """Depth (N,) of the first coarse sample behind a surface [m]; infinite where none is."""
    found = np.full(len(directions), np.inf)
    searching = np.arange(len(directions))
    depths = np.arange(NEAREST_M, far_m + COARSE_STEP_M, COARSE_STEP_M)
    for first in range(0, len(depths), SLAB):
        slab = depths[first : first + SLAB]
        behind = _field(neural_map, origin, directions[searching], slab[None])[..., 0] > 0.0
        hit = behind.any(axis=1)
        found[searching[hit]] = slab[behind[hit].argmax(axis=1)]
        searching = searching[~hit]
        if not len(searching):
            break
    return found


def _rendered(
    neural_map: NeuralMap,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    hit_m: NDArray[np.float64],
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Which rays end at a surface (N,), their colour (N, 3) and depth (N,) [m]."""
    depths = hit_m[:, None] + np.linspace(-COARSE_STEP_M, BEHIND_M, FINE_SAMPLES)
    lengths = np.linalg.norm(directions, axis=1)
    values = torch.from_numpy(_field(neural_map, origin, directions, depths))
    along = torch.from_numpy((depths * lengths[:, None]).astype(np.float32))
    config = neural_map.regions[0].stored.architecture.field_config()
    rendering = render(values[..., 0], values[..., 1:], along, config)
    opacity = rendering.opacity.numpy()
    rgb = rendering.color.numpy() / np.maximum(opacity, 1e-4)[:, None]
    depth_m = (rendering.distance_m.numpy() / lengths).astype(np.float32)
    return opacity >= MIN_OPACITY, rgb, depth_m


def _field(
    neural_map: NeuralMap,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    depths: NDArray[np.float64],
) -> Floats:
    """f and colour (N, S, 4) at depths (N or 1, S) along rays [m]; free where nothing is near."""
    points = origin + depths[..., None] * directions[:, None]
    values = neural_map.values(points.reshape(-1, 3), near_only=True)
    near = np.isfinite(values.distance)
    field = np.zeros((len(near), 4), np.float32)
    field[:, 0] = np.where(near, values.distance, FREE)
    field[near, 1:] = values.color[near]
    return field.reshape(len(directions), -1, 4)
