"""What the stored networks say about any point: the regions' answers, blended (Sec. II-D)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MapConfig
from meslam_core.errors import MapError
from meslam_core.field.model import FieldModel
from meslam_core.field.rendering import surface_level
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

UNKNOWN, FREE, OCCUPIED = np.int8(-1), np.int8(0), np.int8(100)

BATCH = 1 << 18
PROBABILITY_SCALE_M = 0.01
MAX_EXPONENT = 600.0

Points = NDArray[np.floating]


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


class PlacedRegion:
    """A stored region with its network loaded and its place in the map."""

    def __init__(self, stored: StoredRegion, backend: str) -> None:
        self.stored = stored
        self.field: FieldModel = stored.make_field(backend)
        self.rotation = stored.T_map_region[:3, :3]
        self.center = stored.T_map_region[:3, 3]
        self.bounds = _observed_bounds(stored)

    def to_local(self, points: Points) -> NDArray[np.float64]:
        """Points (N, 3) about the region's centre, region axes [m]."""
        return (np.asarray(points, np.float64) - self.center) @ self.rotation

    def touches(self, low: Points, high: Points) -> bool:
        """Whether anything observed may lie in a box of the map frame."""
        return bool((self.bounds[0] <= high).all() and (self.bounds[1] >= low).all())

    def lookup(self, local: Points) -> NDArray[np.uint8]:
        """Flags (N,) of the observed mask at points about the centre."""
        return self.stored.mask.lookup(local)

    def predict(self, local: Points) -> NDArray[np.float32]:
        """f and colour (N, 4) at points about the centre."""
        return self.field.predict((local / self.stored.half_side_m).astype(np.float32))

    def gradient(self, local: Points) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """f and colour (N, 4), and df/dpoint (N, 3) in map axes [1/m]."""
        values, gradient, _ = self.field.probe(
            (local / self.stored.half_side_m).astype(np.float32)
        )
        return values, gradient.astype(np.float64) @ self.rotation.T / self.stored.half_side_m

    def log_weight(self, local: Points, blend_length: float) -> NDArray[np.float64]:
        """Logarithm of the blending weight (N,): minus the distance to the centre."""
        distance = np.linalg.norm(local, axis=1)
        return -np.minimum(distance / (blend_length * self.stored.half_side_m), MAX_EXPONENT)


class NeuralMap:
    """All regions as one continuous map.

    Points are (N, 3) in the map frame [m], any float type. Where several regions have observed
    a point their answers are averaged with weights exp(-d / l): d is the Euclidean distance to
    the region's centre, l the blending length. Occupancy, colour and mesh all come from this
    one blended field. Where no region has observed a point the answer is unknown.

    Args:
        regions: at rest; networks of different width may be mixed, other truncations may not.
        config: blending length in half-sides.
        backend: of the networks, as in `FieldConfig.backend`.

    Raises:
        MapError: when there is no region, or their distance scales differ.
    """

    def __init__(
        self,
        regions: Iterable[StoredRegion],
        config: MapConfig | None = None,
        backend: str = "auto",
    ) -> None:
        self.config = config or MapConfig()
        self.regions = [PlacedRegion(stored, backend) for stored in regions]
        if not self.regions:
            raise MapError("the map holds no region; nothing has been mapped yet")
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
        from meslam_core.map.store import MapStore

        return cls(MapStore(path).load().regions, config, backend)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) of what was observed [m]; zeros if nothing was."""
        boxes = np.array([region.bounds for region in self.regions])
        if not np.isfinite(boxes).any():
            return np.zeros((2, 3))
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

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

    def flags(self, points: Points) -> NDArray[np.uint8]:
        """What any region observed (N,): OBSERVED and NEAR_SURFACE of the mask."""
        points = _checked(points)
        result = np.zeros(len(points), np.uint8)
        for batch in _batches(len(points)):
            for region in self._touching(points[batch]):
                result[batch] |= region.lookup(region.to_local(points[batch]))
        return result

    def values(self, points: Points, only: NDArray[np.bool_] | None = None) -> Values:
        """The blended field at points (N, 3); `only` (N,) leaves the others unevaluated (NaN)."""
        points = _checked(points)
        flags = np.zeros(len(points), np.uint8)
        values = np.empty((len(points), 4), np.float32)
        for batch in _batches(len(points)):
            wanted = None if only is None else only[batch]
            flags[batch], values[batch] = self._blend(points[batch], wanted)
        return Values(flags, values[:, 0], values[:, 1:])

    def gradient(self, points: Points) -> tuple[Values, NDArray[np.float32]]:
        """The blended field and df/dpoint (N, 3) [1/m], map axes, the weights held constant."""
        points = _checked(points)
        flags = np.zeros(len(points), np.uint8)
        values = np.full((len(points), 7), np.nan, np.float32)
        for batch in _batches(len(points)):
            flags[batch], values[batch] = self._blend(points[batch], None, gradient=True)
        return Values(flags, values[:, 0], values[:, 1:4]), values[:, 4:]

    def density(self, points: Points) -> NDArray[np.float32]:
        """Volume density (N,) [1/m]; NaN where unknown."""
        return self.density_scale * np.maximum(self.values(points).distance, 0.0)

    def color(self, points: Points) -> NDArray[np.float32]:
        """RGB (N, 3) in [0, 1]; NaN where unknown. Meaningful near surfaces only."""
        return self.values(points).color

    def signed_distance_m(self, points: Points) -> NDArray[np.float32]:
        """Distance (N,) to the nearest surface [m], POSITIVE behind it, negative in free space.

        It saturates at about the truncation distance; NaN where unknown.
        """
        return self._signed_distance(self.values(points).distance)

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
        values = self.values(points)
        known = (values.flags & OBSERVED) > 0
        depth_m = self._signed_distance(values.distance) + np.float32(0.5 * voxel_m)
        # Only measured surfaces can be occupied; elsewhere rays passed.
        depth_m = np.where(values.flags & NEAR_SURFACE, depth_m, -self.truncation_m)
        probability = 1.0 / (1.0 + np.exp(-np.clip(depth_m / PROBABILITY_SCALE_M, -20, 20)))
        state = np.where(depth_m > 0.0, OCCUPIED, FREE)
        return (
            np.where(known, state, UNKNOWN).astype(np.int8),
            np.where(known, probability, 0.5).astype(np.float32),
        )

    def _signed_distance(self, distance: NDArray[np.float32]) -> NDArray[np.float32]:
        return (distance - np.float32(self.surface_level)) * np.float32(self.truncation_m)

    def _touching(self, points: Points) -> list[PlacedRegion]:
        low, high = points.min(axis=0), points.max(axis=0)
        return [region for region in self.regions if region.touches(low, high)]

    def _blend(
        self, points: Points, only: NDArray[np.bool_] | None, gradient: bool = False
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Flags and the weighted mean of the values of all regions that observed a point."""
        flags = np.zeros(len(points), np.uint8)
        total = np.zeros(len(points))
        mean = np.zeros((len(points), 7 if gradient else 4))
        for region in self._touching(points):
            local = region.to_local(points)
            seen = region.lookup(local)
            flags |= seen
            wanted = (seen & OBSERVED) > 0
            chosen = np.flatnonzero(wanted if only is None else wanted & only)
            if not len(chosen):
                continue
            values: NDArray[np.floating] = np.empty(0)
            if gradient:
                values = np.concatenate(region.gradient(local[chosen]), axis=1)
            else:
                values = region.predict(local[chosen])
            weight = np.exp(region.log_weight(local[chosen], self.config.blend_length))
            total[chosen] += weight
            mean[chosen] += weight[:, None] * values
        with np.errstate(invalid="ignore"):
            return flags, (mean / total[:, None]).astype(np.float32)


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
    return np.stack([placed.min(axis=0), placed.max(axis=0)])


def _checked(points: Points) -> NDArray[np.float64]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MapError(f"points have the shape {points.shape}, expected (N, 3)")
    if not np.isfinite(points).all():
        raise MapError("points hold values that are not finite")
    return points


def _batches(count: int) -> Iterator[slice]:
    return (slice(start, start + BATCH) for start in range(0, count, BATCH))
