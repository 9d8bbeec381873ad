"""What the stored networks say about any point: the regions' answers, blended (Sec. II-D)."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MapConfig
from meslam_core.errors import MapError
from meslam_core.field.rendering import surface_level
from meslam_core.map.lattice import unique_cells
from meslam_core.map.placed_region import PlacedRegion, Points
from meslam_core.map.reader import read_map
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

UNKNOWN, FREE, OCCUPIED = np.int8(-1), np.int8(0), np.int8(100)

BATCH = 1 << 16
PROBABILITY_SCALE_M = 0.01


@dataclass(frozen=True)
class Values:
    """The blended field at points.

    Attributes:
        flags: (N,) uint8, the observed mask's OBSERVED and NEAR_SURFACE, by any region.
        distance: (N,) float32 truncated signed distance f, positive behind the zero crossing;
            NaN where no region has observed the point.
        color: (N, 3) float32 in [0, 1]; NaN where unobserved.
    """

    flags: NDArray[np.uint8]
    distance: NDArray[np.float32]
    color: NDArray[np.float32]


class NeuralMap:
    """All regions as one continuous map.

    Points are (N, 3) in the map frame [m], any float type. Where several regions have observed
    a point their answers are averaged with weights exp(-d / l): d is the Euclidean distance to
    the region's centre, l the blending length. Occupancy, colour and mesh all come from this
    one blended field. Where no region has observed a point the answer is unknown.

    Args:
        regions: at rest; those of another map are taken as they are. Networks of different width
            may be mixed, other truncations may not.
        config: blending length in half-sides.
        backend: of the networks, as in `FieldConfig.backend`.

    Raises:
        MapError: when there is no region, or their distance scales differ.
    """

    def __init__(
        self,
        regions: Iterable[StoredRegion | PlacedRegion],
        config: MapConfig | None = None,
        backend: str = "auto",
    ) -> None:
        self.config = config or MapConfig()
        self.regions = [
            region if isinstance(region, PlacedRegion) else PlacedRegion(region, backend)
            for region in regions
        ]
        if not self.regions:
            raise MapError("the map holds no region; nothing has been mapped yet; run more frames")
        architecture = self.regions[0].stored.architecture
        scales = (architecture.truncation_m, architecture.density_scale)
        for region in self.regions:
            other = region.stored.architecture
            if (other.truncation_m, other.density_scale) != scales:
                raise MapError(
                    f"region {region.stored.index} has truncation and density scale "
                    f"{(other.truncation_m, other.density_scale)}, the first has {scales}; "
                    "only maps made with the same settings can be joined"
                )
        self.truncation_m, self.density_scale = scales
        self.surface_level = surface_level(architecture.field_config())

    @classmethod
    def load(
        cls, path: str | Path, config: MapConfig | None = None, backend: str = "auto"
    ) -> NeuralMap:
        """The map in a store; damaged regions are left out (see `MapStore.load`).

        Raises:
            MapError: when the path is no map or nothing of it can be read.
        """
        return cls(read_map(Path(path)).regions, config, backend)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) of what was observed [m]; zeros if nothing was."""
        boxes = np.array([region.bounds for region in self.regions])
        if not np.isfinite(boxes).any():
            return np.zeros((2, 3))
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @property
    def observed_volume_m3(self) -> float:
        """Volume that any region observed, counted once [m^3]; good to a voxel at borders."""
        voxel_m = min(region.stored.mask.voxel_m for region in self.regions)
        seen = [np.floor(region.observed_centers() / voxel_m) for region in self.regions]
        return float(len(unique_cells(np.concatenate(seen).astype(np.int64)))) * voxel_m**3

    def subset(self, indices: Iterable[RegionIndex]) -> list[PlacedRegion]:
        """The regions with the given places on the lattice.

        Raises:
            MapError: naming those that do not exist.
        """
        by_index: dict[RegionIndex, list[PlacedRegion]] = {}
        for region in self.regions:
            by_index.setdefault(region.stored.index, []).append(region)
        wanted = list(dict.fromkeys(indices))
        missing = [index for index in wanted if index not in by_index]
        if missing:
            raise MapError(f"there is no region {missing[0]}; the map has {sorted(by_index)}")
        return [region for index in wanted for region in by_index[index]]

    def touching(self, low: Points, high: Points) -> list[PlacedRegion]:
        """The regions that may have observed something between two corners (3,) [m]."""
        return [region for region in self.regions if region.touches(low, high)]

    def only(self, region: PlacedRegion) -> NeuralMap:
        """One of the regions as a map of its own, without the others' part in the blend."""
        single = copy.copy(self)
        single.regions = [region]
        return single

    def assigned(
        self, region: PlacedRegion, points: Points, margin_m: float = 0.0
    ) -> NDArray[np.bool_]:
        """Which points (N, 3) are a region's when every region tells its own part of the map.

        Those in its box or so near to it [m], and those in no box at all.
        """
        own = region.in_box(points, margin_m)
        rest = np.flatnonzero(~own)
        if len(rest):
            outside = points[rest]
            low, high = outside.min(axis=0), outside.max(axis=0)
            free = np.ones(len(rest), bool)
            for other in self.regions:
                if other is not region and other.box_touches(low, high):
                    free &= ~other.in_box(outside)
            own[rest] = free
        return own

    def flags(self, points: Points) -> NDArray[np.uint8]:
        """What any region observed (N,): OBSERVED and NEAR_SURFACE of the mask."""
        points = _checked(points)
        result = np.zeros(len(points), np.uint8)
        for batch in _batches(len(points)):
            for region in self._touching(points[batch]):
                result[batch] |= region.lookup(region.to_local(points[batch]))
        return result

    def values(self, points: Points, near_only: bool = False) -> Values:
        """The blended field at points (N, 3).

        Args:
            points: (N, 3).
            near_only: evaluate only where a surface was seen near, NaN elsewhere; faster.
        """
        points = _checked(points)
        flags = np.zeros(len(points), np.uint8)
        values = np.empty((len(points), 4), np.float32)
        for batch in _batches(len(points)):
            flags[batch], values[batch] = self._blend(points[batch], near_only)
        return Values(flags, values[:, 0], values[:, 1:])

    def gradient(self, points: Points) -> tuple[Values, NDArray[np.float32]]:
        """The blended field and df/dpoint (N, 3) [1/m], map axes, the weights held constant."""
        points = _checked(points)
        flags = np.zeros(len(points), np.uint8)
        values = np.full((len(points), 7), np.nan, np.float32)
        for batch in _batches(len(points)):
            flags[batch], values[batch] = self._blend(points[batch], gradient=True)
        return Values(flags, values[:, 0], values[:, 1:4]), values[:, 4:]

    def density(self, points: Points) -> NDArray[np.float32]:
        """Volume density (N,) [1/m]; NaN where unknown."""
        return np.float32(self.density_scale) * np.maximum(self.values(points).distance, 0.0)

    def color(self, points: Points) -> NDArray[np.float32]:
        """RGB (N, 3) in [0, 1]; NaN where unknown. Meaningful near surfaces only."""
        return self.values(points).color

    def signed_distance_m(self, points: Points) -> NDArray[np.float32]:
        """Distance (N,) to the nearest surface [m], POSITIVE behind it, negative in free space.

        It saturates at about the truncation distance; NaN where unknown.
        """
        return self.to_meters(self.values(points).distance)

    def occupancy(
        self, points: Points, voxel_m: float = 0.0
    ) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
        """Whether points are occupied.

        A point is occupied when it lies behind a surface that was seen, as deep as the
        truncation distance; deeper space was never observed and is unknown. With a voxel
        size, points stand for voxels: one whose centre lies up to half its side before the
        surface contains the surface and is occupied.

        Args:
            points: (N, 3).
            voxel_m: side of the voxels that the points stand for [m]; 0 for points.

        Returns:
            state: (N,) int8, UNKNOWN -1, FREE 0, OCCUPIED 100.
            probability: (N,) float32 of being occupied: the logistic function of the signed
                distance (plus half the voxel) over one centimetre, the accuracy of a map;
                0.5 where unknown.
        """
        values = self.values(points, near_only=True)
        known = values.flags & OBSERVED > 0
        depth_m = self.to_meters(values.distance) + np.float32(0.5 * voxel_m)
        # Only measured surfaces can be occupied; elsewhere rays passed.
        depth_m = np.where(values.flags & NEAR_SURFACE, depth_m, -self.truncation_m)
        probability = 1.0 / (1.0 + np.exp(-np.clip(depth_m / PROBABILITY_SCALE_M, -20, 20)))
        state = np.where(depth_m > 0.0, OCCUPIED, FREE)
        return (
            np.where(known, state, UNKNOWN).astype(np.int8),
            np.where(known, probability, 0.5).astype(np.float32),
        )

    def to_meters(self, distance: NDArray[np.float32]) -> NDArray[np.float32]:
        """Signed distance to the surface [m], positive behind it, of values of f."""
        return (distance - np.float32(self.surface_level)) * np.float32(self.truncation_m)

    def _touching(self, points: Points) -> list[PlacedRegion]:
        return self.touching(points.min(axis=0), points.max(axis=0))

    def _blend(
        self, points: Points, near_only: bool = False, gradient: bool = False
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Flags and the weighted mean of the values of all regions that observed a point."""
        flags = np.zeros(len(points), np.uint8)
        located = []
        for region in self._touching(points):
            local = region.to_local(points)
            seen = region.lookup(local)
            flags |= seen
            located.append((region, local, seen & OBSERVED > 0))
        wanted = flags & (NEAR_SURFACE if near_only else OBSERVED) > 0
        chosen = []
        total = np.zeros(len(points))
        for region, local, observed in located:
            rows = np.flatnonzero(observed & wanted)
            if len(rows):
                local = local[rows] if len(rows) < len(points) else local
                weight = np.exp(region.log_weight(local, self.config.blend_length))
                total[rows] += weight
                chosen.append((region, local, rows, weight))
        result = np.zeros((len(points), 7 if gradient else 4), np.float32)
        for region, local, rows, weight in chosen:
            values = (
                np.concatenate(region.gradient(local), axis=1, dtype=np.float32)
                if gradient
                else region.predict(local)
            )
            if len(chosen) > 1:
                values *= (weight / total[rows]).astype(np.float32)[:, None]
            if len(rows) < len(points):
                values += result.take(rows, axis=0)
                result[rows] = values
            else:
                result += values
        result[total == 0.0] = np.nan
        return flags, result


def _checked(points: Points) -> NDArray[np.float64]:
    checked: NDArray[np.float64] = np.asarray(points, np.float64)
    if checked.ndim != 2 or checked.shape[1] != 3:
        raise MapError(f"points have the shape {checked.shape}, expected (N, 3)")
    if not np.isfinite(checked).all():
        raise MapError("points hold values that are not finite")
    return checked


def _batches(count: int) -> Iterator[slice]:
    return (slice(start, start + BATCH) for start in range(0, count, BATCH))
