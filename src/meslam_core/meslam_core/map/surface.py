"""Points on the map's surfaces, and how far any point is from the nearest of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meslam_core.errors import MapError
from meslam_core.map.neural_map import NeuralMap

DEFAULT_SPACING_M = 0.04
NEWTON_STEPS = 2


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces, at most one in each cube of the spacing.

    Attributes:
        positions: (N, 3) float32, map frame [m].
        normals: (N, 3) float32 unit vectors into free space.
        colors: (N, 3) uint8 RGB.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]


def surface_points(neural_map: NeuralMap, spacing_m: float = DEFAULT_SPACING_M) -> SurfacePoints:
    """Points on every surface that was seen, by Newton steps from the observed mask's voxels.

    Raises:
        MapError: when the spacing makes no sense.
    """
    if not 0.005 <= spacing_m <= 1.0:
        raise MapError(f"a point spacing of {spacing_m} m is outside 0.005 to 1 m")
    found = [np.zeros((0, 9), np.float32)]
    for region in neural_map.regions:
        centers = region.observed_centers(near_surface=True)
        voxel_m = region.stored.mask.voxel_m
        count = max(1, round(voxel_m / spacing_m))
        offsets = ((np.arange(count) + 0.5) / count - 0.5) * voxel_m
        for offset in np.stack(np.meshgrid(offsets, offsets, offsets), axis=-1).reshape(-1, 3):
            found.append(_on_surface(neural_map, centers + offset, 0.9 * voxel_m / count))
    points = np.concatenate(found)
    cubes = np.floor(points[:, :3] / spacing_m).astype(np.int32)
    _, kept = np.unique(cubes, axis=0, return_index=True)
    points = points[kept]
    colors = np.round(points[:, 6:] * 255.0).astype(np.uint8)
    return SurfacePoints(points[:, :3], points[:, 3:6], colors)


def _on_surface(
    neural_map: NeuralMap, points: NDArray[np.floating], reach_m: float
) -> NDArray[np.float32]:
    """Position, normal and colour (M, 9) of those points (N, 3) that have a surface in reach."""
    start = points
    for step in range(NEWTON_STEPS + 1):
        values, gradient = neural_map.gradient(points)
        slope = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
        ahead_m = (neural_map.surface_level - values.distance) / slope
        good = np.isfinite(ahead_m) & (np.linalg.norm(points - start, axis=1) <= reach_m)
        good &= np.abs(ahead_m) <= (reach_m if step == 0 else 0.25 * reach_m)
        points, start, ahead_m = points[good], start[good], ahead_m[good]
        normals = -gradient[good] / slope[good, None]
        if step < NEWTON_STEPS:
            points = points - ahead_m[:, None] * normals
    return np.concatenate([points, normals, values.color[good]], axis=1).astype(np.float32)


class SurfaceIndex:
    """Distances to the nearest surface, also far from it, where the field itself saturates.

    Args:
        neural_map: to ask.
        spacing_m: of the surface points searched [m].
    """

    def __init__(self, neural_map: NeuralMap, spacing_m: float = DEFAULT_SPACING_M) -> None:
        self.points = surface_points(neural_map, spacing_m)
        self._map = neural_map
        self._tree = cKDTree(self.points.positions)

    def distance_m(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distance (N,) of points (N, 3) to the nearest surface that was seen [m].

        Never negative; infinite where the map has no surface. Within half the truncation
        distance it is the field's, elsewhere that to the nearest surface point.
        """
        searched = np.asarray(self._tree.query(points, workers=1)[0], np.float32)
        values = self._map.values(points, near_only=True)
        near = np.abs(self._map.to_meters(values.distance))
        return np.where(near < 0.5 * self._map.truncation_m, near, searched)
