"""Points on the map's surfaces, and how far any point is from the nearest of them."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from meslam_core.errors import MapError
from meslam_core.map.lattice import cell_numbers
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.placed_region import PlacedRegion

DEFAULT_SPACING_M = 0.04
NEWTON_STEPS = 2
# Distances in the field grow at most so fast: what is farther from a surface is not tried.
MAX_SLOPE = 1.5

Floats = NDArray[np.float32]
Key = tuple[tuple[int, int, int], int, bytes, float]


@dataclass(frozen=True)
class SurfacePoints:
    """Points on surfaces, at most one in each cube of the spacing.

    Attributes:
        positions: (N, 3) float32, map frame [m].
        normals: (N, 3) float32 unit vectors into free space.
        colors: (N, 3) uint8 RGB.
    """

    positions: Floats
    normals: Floats
    colors: NDArray[np.uint8]


def surface_points(neural_map: NeuralMap, spacing_m: float = DEFAULT_SPACING_M) -> SurfacePoints:
    """Points on every surface that was seen, by Newton steps from the observed mask's voxels.

    Raises:
        MapError: when the spacing makes no sense.
    """
    return MapSurfaces(neural_map).points(spacing_m)


class MapSurfaces:
    """Surfaces of a map and distances to them, also far off, where the field itself saturates.

    Points are found region by region when they are first needed. Usable from any thread.

    Args:
        neural_map: to ask.
        known: of the map as it was before; what it found of regions that have not changed since
            is taken over.
    """

    def __init__(self, neural_map: NeuralMap, known: MapSurfaces | None = None) -> None:
        self._map = neural_map
        self._lock = threading.Lock()
        self._found: dict[Key, Floats] = {}
        self._tree: tuple[list[Key], cKDTree] | None = None
        if known is not None:
            versions = {_version(region) for region in neural_map.regions}
            with known._lock:
                self._found = {k: v for k, v in known._found.items() if k[:3] in versions}
                self._tree = known._tree

    def points(self, spacing_m: float = DEFAULT_SPACING_M) -> SurfacePoints:
        """Points on every surface that was seen.

        Raises:
            MapError: when the spacing makes no sense.
        """
        if not 0.005 <= spacing_m <= 1.0:
            raise MapError(f"a point spacing of {spacing_m} m is outside 0.005 to 1 m")
        with self._lock:
            found = [self._of(region, spacing_m) for region in self._map.regions]
        points = np.concatenate([np.zeros((0, 9), np.float32), *found])
        points = points[_one_a_cube(points, spacing_m)]
        colors = np.round(points[:, 6:] * 255.0).astype(np.uint8)
        return SurfacePoints(points[:, :3], points[:, 3:6], colors)

    def distance_m(self, points: NDArray[np.floating], farthest_m: float = np.inf) -> Floats:
        """Distance (N,) of points (N, 3) to the nearest surface that was seen [m].

        Never negative, never more than `farthest_m`; infinite where the map has no surface. Within
        half the truncation distance it is the field's, elsewhere that to the nearest surface point.
        """
        values = self._map.values(points, near_only=True)
        near = np.abs(self._map.to_meters(values.distance))
        result = np.full(len(near), np.float32(farthest_m))
        far = np.flatnonzero(~(near < 0.5 * self._map.truncation_m))
        if len(far):
            result[far] = self._searched(np.asarray(points, np.float64)[far], farthest_m)
        return np.where(near < 0.5 * self._map.truncation_m, near, result).astype(np.float32)

    def signed_distance_m(self, points: NDArray[np.floating], farthest_m: float = 0.0) -> Floats:
        """Distance (N,), positive in free space and negative behind a surface; NaN where unknown.

        Args:
            points: (N, 3).
            farthest_m: distances are clipped at plus and minus this [m]; 0 takes the truncation
                distance, within which the field answers alone.
        """
        # The field's distance grows behind the surface, the answer's in free space.
        ahead = -self._map.signed_distance_m(points)
        limit = np.float32(farthest_m or self._map.truncation_m)
        if limit > self._map.truncation_m:
            known = np.flatnonzero(np.isfinite(ahead))
            distance = self.distance_m(np.asarray(points)[known], float(limit))
            ahead[known] = np.copysign(distance, ahead[known])
        return ahead.clip(-limit, limit)

    def _searched(self, points: NDArray[np.float64], farthest_m: float) -> Floats:
        """Distance (N,) to the nearest surface point, at most `farthest_m`."""
        low, high = points.min(axis=0) - farthest_m, points.max(axis=0) + farthest_m
        with self._lock:
            regions = self._map.touching(low, high)
            found = [self._of(region, DEFAULT_SPACING_M) for region in regions]
            keys = [_key(region, DEFAULT_SPACING_M) for region in regions]
            if not sum(map(len, found)):
                return np.full(len(points), np.float32(farthest_m))
            if self._tree is None or self._tree[0] != keys:
                self._tree = keys, cKDTree(np.concatenate(found)[:, :3])
            tree = self._tree[1]
        distances = tree.query(points, workers=1, distance_upper_bound=farthest_m)[0]
        return np.minimum(distances, farthest_m).astype(np.float32)

    def _of(self, region: PlacedRegion, spacing_m: float) -> Floats:
        """Position, normal and colour (M, 9) of a region's surface points."""
        key = _key(region, spacing_m)
        if key not in self._found:
            self._found[key] = _region_points(self._map, region, spacing_m)
        return self._found[key]


def _version(region: PlacedRegion) -> tuple[tuple[int, int, int], int, bytes]:
    stored = region.stored
    return stored.index, stored.version, stored.T_map_region.tobytes()


def _key(region: PlacedRegion, spacing_m: float) -> Key:
    return *_version(region), spacing_m


def _region_points(neural_map: NeuralMap, region: PlacedRegion, spacing_m: float) -> Floats:
    """Points (M, 9) on the surfaces in a region's box, and in what it saw outside all boxes."""
    centers = region.observed_centers(near_surface=True)
    centers = centers[neural_map.assigned(region, centers)]
    # The blend differs by millimetres; it costs as many times more as regions have seen a place.
    alone = neural_map.only(region)
    voxel_m = region.stored.mask.voxel_m
    centers = centers[_near(alone, centers, voxel_m)]
    count = max(1, round(voxel_m / spacing_m))
    offsets = ((np.arange(count) + 0.5) / count - 0.5) * voxel_m
    found = [np.zeros((0, 9), np.float32)]
    for offset in np.stack(np.meshgrid(offsets, offsets, offsets), axis=-1).reshape(-1, 3):
        points = centers + offset @ region.rotation.T
        points = points[_near(alone, points, voxel_m / count)]
        found.append(_on_surface(neural_map, alone, points, 0.9 * voxel_m / count))
    rows: Floats = np.concatenate(found).astype(np.float32, copy=False)
    return rows[_one_a_cube(rows, spacing_m)]


def _near(neural_map: NeuralMap, centers: NDArray[np.float64], side_m: float) -> NDArray[np.bool_]:
    """Which cubes may hold a surface, by the field at their centres (N, 3)."""
    distance = np.abs(neural_map.to_meters(neural_map.values(centers).distance))
    return np.asarray(distance <= 0.5 * np.sqrt(3.0) * MAX_SLOPE * side_m, np.bool_)


def _one_a_cube(points: Floats, spacing_m: float) -> NDArray[np.intp]:
    """Numbers of points (N, 9), one for each cube of the spacing that holds any."""
    cubes = np.floor(points[:, :3] / spacing_m).astype(np.int64)
    return np.unique(cell_numbers(cubes), return_index=True)[1]


def _on_surface(
    neural_map: NeuralMap, alone: NeuralMap, points: NDArray[np.floating], reach_m: float
) -> Floats:
    """Position, normal and colour (M, 9) of those points (N, 3) that have a surface in reach.

    The first steps are those of one region alone, the last one is that of the blended map.
    """
    start = points
    for step in range(NEWTON_STEPS + 1):
        values, gradient = (alone if step < NEWTON_STEPS - 1 else neural_map).gradient(points)
        slope = np.maximum(np.linalg.norm(gradient, axis=1), 1e-6)
        ahead_m = (neural_map.surface_level - values.distance) / slope
        good = np.isfinite(ahead_m) & (np.linalg.norm(points - start, axis=1) <= reach_m)
        good &= np.abs(ahead_m) <= (reach_m if step == 0 else 0.25 * reach_m)
        points, start, ahead_m = points[good], start[good], ahead_m[good]
        normals = -gradient[good] / slope[good, None]
        if step < NEWTON_STEPS:
            points = points - ahead_m[:, None] * normals
    return np.concatenate([points, normals, values.color[good]], axis=1).astype(np.float32)
