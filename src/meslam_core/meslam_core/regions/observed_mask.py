"""Which space a region has seen; a network answers everywhere, also where nobody looked."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Without the kernel the numpy implementation marks the same voxels, more slowly.
_kernel: Any = None
with contextlib.suppress(ImportError):
    from meslam_core.field import _kernel

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

    def _locate(self, points: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
        """Rows of the points (N, 3) inside the cube, and their flat voxel numbers."""
        count = self.flags.shape[0]
        x, y, z = (points.T / self.voxel_m + 0.5 * count).astype(np.float32, copy=False)
        inside = (x >= 0) & (x < count) & (y >= 0) & (y < count) & (z >= 0) & (z < count)
        rows = np.flatnonzero(inside)
        if len(rows) < len(x):
            x, y, z = x[rows], y[rows], z[rows]
        flat = (x.astype(np.int32) * count + y.astype(np.int32)) * count + z.astype(np.int32)
        return rows, flat

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
        if not len(distances_m):
            return
        if _kernel is not None:
            _kernel.mark_rays(
                self.flags,
                np.ascontiguousarray(origin, np.float32),
                np.ascontiguousarray(directions, np.float32),
                np.ascontiguousarray(distances_m, np.float32),
                voxel_m=self.voxel_m,
                truncation_m=truncation_m,
                along=OBSERVED,
                at_end=OBSERVED | NEAR_SURFACE,
            )
            return
        flat = self.flags.reshape(-1)
        # In the order of their length, the rays that reach a distance are the last ones.
        order = np.argsort(distances_m)
        lengths = np.asarray(distances_m, np.float32)[order]
        rays = np.asarray(directions, np.float32)[order]
        start = np.asarray(origin, np.float32)
        seen = lengths + np.float32(truncation_m)
        steps = np.arange(0.0, float(seen[-1]), self.voxel_m, dtype=np.float32)
        for along, first in zip(steps, np.searchsorted(seen, steps), strict=True):
            _, voxels = self._locate(start + along * rays[first:])
            flat[voxels] |= OBSERVED
        for offset in np.linspace(-truncation_m, truncation_m, 5, dtype=np.float32):
            _, voxels = self._locate(start + (lengths + offset)[:, None] * rays)
            flat[voxels] |= OBSERVED | NEAR_SURFACE

    def lookup(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Flags (N,) at points (N, 3) about the region's centre [m]; 0 outside the cube."""
        rows, voxels = self._locate(points)
        if len(rows) == len(points):
            return self.flags.reshape(-1)[voxels]
        result = np.zeros(len(points), np.uint8)
        result[rows] = self.flags.reshape(-1)[voxels]
        return result

    @property
    def observed_volume_m3(self) -> float:
        """Volume of the observed voxels [m^3]."""
        return float(np.count_nonzero(self.flags & OBSERVED)) * self.voxel_m**3

    def moved(self, offset_m: NDArray[np.floating]) -> ObservedMask:
        """The same observations about a centre moved by (3,) [m], to the nearest voxel.

        What lies outside the moved cube is forgotten.
        """
        count = self.flags.shape[0]
        steps = np.rint(np.asarray(offset_m) / self.voxel_m).astype(int)
        mask = ObservedMask.from_flags(np.zeros_like(self.flags), self.voxel_m)
        steps = np.clip(steps, -count, count)
        here = tuple(slice(max(0, -s), min(count, count - s)) for s in steps)
        there = tuple(slice(max(0, s), min(count, count + s)) for s in steps)
        mask.flags[here] = self.flags[there]
        return mask

    def clear(self) -> None:
        """Forget everything."""
        self.flags[:] = 0
