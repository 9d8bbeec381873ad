"""Replay of what nobody has images of any more: views of a region as its network remembers it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.field.rendering import surface_level
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose

Doubles = NDArray[np.float64]

# Places to look from that are compared with each other, and how far apart samples of a ray lie.
CANDIDATES = 4000
STEP_M = 0.04
FARTHEST_M = 8.0


def remembered_views(
    region: Region, count: int, rays: int, generator: np.random.Generator
) -> Iterator[tuple[Pose, Rays]]:
    """Views in all directions from free places of a region, rendered from its network.

    A ray counts where all the way to its surface was observed. Trained on these, a network keeps
    what it says there.

    Args:
        region: awake.
        count: of places, spread over the free space within the box.
        rays: that are cast from each; fewer meet a surface.
        generator: of places and directions.

    Yields:
        T_map_camera (4, 4), map axes, and the rays that met a surface.
    """
    for place in _places(region, count, generator):
        directions = generator.normal(size=(rays, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        view = _cast(region, place, directions)
        if len(view):
            T_region_view = np.eye(4)
            T_region_view[:3, 3] = place
            yield region.T_map_region @ T_region_view, view


def _places(region: Region, count: int, generator: np.random.Generator) -> Doubles:
    """Places (N, 3) about the region's centre [m], each as far as can be from those before."""
    mask = region.mask
    free = np.argwhere((mask.flags & (OBSERVED | NEAR_SURFACE)) == OBSERVED)
    if not len(free):
        return np.zeros((0, 3))
    places = (free + 0.5) * mask.voxel_m - mask.half_extent_m
    inside = (np.abs(places) < region.half_side_m).all(axis=1)
    places = places[inside] if inside.any() else places
    places = places[generator.permutation(len(places))[:CANDIDATES]]
    chosen = [0]
    apart = np.linalg.norm(places - places[0], axis=1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return np.asarray(places[chosen], np.float64)


def _cast(region: Region, origin: Doubles, directions: Doubles) -> Rays:
    """The rays from a place that meet the mapped surface before they leave observed space."""
    level = surface_level(region.field_config)
    distances = np.full(len(directions), np.nan)
    colors = np.zeros((len(directions), 3))
    before = np.full(len(directions), -1.0)
    going = np.arange(len(directions))
    for along in np.arange(STEP_M, FARTHEST_M, STEP_M):
        points = (origin + along * directions[going]).astype(np.float32)
        seen = region.mask.lookup(points) & OBSERVED > 0
        going, points = going[seen], points[seen]
        if not len(going):
            break
        values = region.field.predict(points / np.float32(region.half_side_m))
        now = values[:, 0].astype(np.float64)
        hit = (now >= level) & (before[going] < level)
        slope = np.maximum(now - before[going], 1e-6)
        distances[going[hit]] = along - STEP_M * ((now - level) / slope)[hit]
        colors[going[hit]] = values[hit, 1:]
        before[going] = now
        going = going[~hit]
    met = distances > STEP_M
    return Rays(
        torch.from_numpy(directions[met].astype(np.float32)),
        torch.from_numpy(distances[met].astype(np.float32)),
        torch.from_numpy(colors[met].astype(np.float32)),
    )
