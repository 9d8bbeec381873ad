"""Which space a region has seen; a network answers everywhere, also where nobody looked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

OBSERVED = np.uint8(1)
NEAR_SURFACE = np.uint8(2)


class ObservedMask:
    """Voxels of a cube about a region's centre: traversed by a ray, and close to a surface.

    Args:
        half_extent_m: half the side of the cube [m].
        voxel_m: side of a voxel [m].

    Attributes:
        flags: (n, n, n) uint8, bits OBSERVED and NEAR_SURFACE, indexed [x, y, z].
    """

    def __init__(self, half_extent_m: float, voxel_m: float) -> None:
        count = 2 * int(np.ceil(half_extent_m / voxel_m))
        self._set(np.zeros((count, count, count), np.uint8), voxel_m)

    @classmethod
    def from_flags(cls, flags: NDArray[np.uint8], voxel_m: float) -> ObservedMask:
        """A mask from stored flags (n, n, n) with n even."""
        mask = cls.__new__(cls)
        mask._set(flags, voxel_m)
        return mask

    def _set(self, flags: NDArray[np.uint8], voxel_m: float) -> None:
        self.flags = flags
        self.voxel_m = float(voxel_m)
        self.half_extent_m = 0.5 * flags.shape[0] * self.voxel_m

    def _indices(self, points: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Flat voxel numbers (N,) and which points lie in the cube."""
        count = self.flags.shape[0]
        voxels = np.floor((points + self.half_extent_m) / self.voxel_m)
        inside = ((voxels >= 0) & (voxels < count)).all(axis=-1)
        voxels = np.where(inside[..., None], voxels, 0).astype(np.int64)
        return (voxels[..., 0] * count + voxels[..., 1]) * count + voxels[..., 2], inside

    def integrate(
        self,
        origin: NDArray[np.floating],
        directions: NDArray[np.floating],
        distances_m: NDArray[np.floating],
        truncation_m: float,
    ) -> None:
        """Mark what rays saw.

        Args:
            origin: (3,) camera centre about the region's centre [m].
            directions: (R, 3) unit vectors, region axes.
            distances_m: (R,) distance of the surface [m].
            truncation_m: depth behind the surface that counts as seen [m].
        """
        flat = self.flags.reshape(-1)
        steps = np.arange(0.0, float(distances_m.max(initial=0.0)) + truncation_m, self.voxel_m)
        for along in steps:
            reached = distances_m + truncation_m >= along
            points = origin + along * directions[reached]
            index, inside = self._indices(points)
            flat[index[inside]] |= OBSERVED
        for offset in np.linspace(-truncation_m, truncation_m, 5):
            points = origin + (distances_m + offset)[:, None] * directions
            index, inside = self._indices(points)
            flat[index[inside]] |= OBSERVED | NEAR_SURFACE

    def lookup(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Flags (N,) at points (N, 3) about the region's centre [m]; 0 outside the cube."""
        index, inside = self._indices(points)
        return np.where(inside, self.flags.reshape(-1)[index], np.uint8(0))

    @property
    def observed_volume_m3(self) -> float:
        """Volume of the observed voxels [m^3]."""
        return float(np.count_nonzero(self.flags & OBSERVED)) * self.voxel_m**3

    def clear(self) -> None:
        """Forget everything."""
        self.flags[:] = 0
