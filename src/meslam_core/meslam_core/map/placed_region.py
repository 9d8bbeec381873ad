"""A stored region in its place in the map, with its network ready to answer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.field.model import FieldModel
from meslam_core.map.lattice import true_cells
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

MAX_EXPONENT = 600.0

Points = NDArray[np.floating]


class PlacedRegion:
    """A stored region with its network loaded and its place in the map."""

    def __init__(self, stored: StoredRegion, backend: str) -> None:
        self.stored = stored
        self.field: FieldModel = stored.make_field(backend)
        self.rotation = stored.T_map_region[:3, :3]
        self.center = stored.T_map_region[:3, 3]
        self.bounds = _observed_bounds(stored)

    def to_local(self, points: Points) -> NDArray[np.float32]:
        """Points (N, 3) about the region's centre, region axes [m]."""
        local = (points - self.center).astype(np.float32)
        if np.array_equal(self.rotation, np.eye(3)):
            return local
        x, y, z = self.rotation.astype(np.float32)
        turned: NDArray[np.float32] = local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * z
        return turned

    def touches(self, low: Points, high: Points) -> bool:
        """Whether anything observed may lie in a box of the map frame."""
        return bool((self.bounds[0] <= high).all() and (self.bounds[1] >= low).all())

    def in_box(self, points: Points, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Which points (N, 3) of the map frame lie in the region's box, or so near to it."""
        inside = np.ones(len(points), bool)
        for column in self.to_local(points).T:
            inside &= np.abs(column) <= self.stored.half_side_m + margin_m
        return inside

    def box_touches(self, low: Points, high: Points) -> bool:
        """Whether the region's box may reach into a box of the map frame."""
        reach = self.stored.half_side_m * np.abs(self.rotation).sum(axis=1)
        return bool((self.center - reach <= high).all() and (self.center + reach >= low).all())

    def observed_centers(self, near_surface: bool = False) -> NDArray[np.float64]:
        """Centres (N, 3) of the voxels observed, or of those near a surface, map frame [m]."""
        mask = self.stored.mask
        voxels = true_cells(mask.flags & (NEAR_SURFACE if near_surface else OBSERVED))
        local = (voxels + 0.5) * mask.voxel_m - mask.half_extent_m
        centers: NDArray[np.float64] = local @ self.rotation.T + self.center
        return centers

    def lookup(self, local: Points) -> NDArray[np.uint8]:
        """Flags (N,) of the observed mask at points about the centre."""
        return self.stored.mask.lookup(local)

    def predict(self, local: Points) -> NDArray[np.float32]:
        """f and colour (N, 4) at points about the centre."""
        return self.field.predict(self._unit(local))

    def gradient(self, local: Points) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """f and colour (N, 4), and df/dpoint (N, 3) in map axes [1/m]."""
        values, gradient, _ = self.field.probe(self._unit(local))
        return values, gradient.astype(np.float64) @ self.rotation.T / self.stored.half_side_m

    def _unit(self, local: Points) -> NDArray[np.float32]:
        """Region coordinates, [-1, 1] inside the box."""
        return np.multiply(local, 1.0 / self.stored.half_side_m, dtype=np.float32)

    def log_weight(self, local: Points, blend_length: float) -> NDArray[np.float64]:
        """Logarithm of the blending weight (N,): minus the distance to the centre."""
        distance = np.sqrt(np.einsum("ij,ij->i", local, local), dtype=np.float64)
        lengths: NDArray[np.float64] = distance / (blend_length * self.stored.half_side_m)
        return np.negative(np.minimum(lengths, MAX_EXPONENT))


def _observed_bounds(stored: StoredRegion) -> NDArray[np.float64]:
    """Box (2, 3) of the map frame around everything a region observed; empty is (inf, -inf)."""
    mask = stored.mask
    corners = []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        used = np.flatnonzero(mask.flags.any(axis=others))
        if not len(used):
            return np.array([[np.inf] * 3, [-np.inf] * 3])
        corners.append(np.array([used[0], used[-1] + 1]) * mask.voxel_m - mask.half_extent_m)
    box = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, 3)
    placed = box @ stored.T_map_region[:3, :3].T + stored.T_map_region[:3, 3]
    result = np.empty((2, 3))
    result[0], result[1] = placed.min(axis=0), placed.max(axis=0)
    return result
