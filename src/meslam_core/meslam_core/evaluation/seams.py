"""How far a map's surface jumps where one region takes over from the next.

A seam is the plane midway between two neighbouring regions' centres, inside both boxes. Where the
surface crosses it, the surface's height is followed along its normal from 2 to 10 cm on both
sides; a straight line through the heights of each side is continued to the seam, and the
difference of the two ends there is the jump. Of a flat surface it is 0 however the surface lies;
a corner within reach counts as one, the same with and without blending.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.placed_region import PlacedRegion

Floats = NDArray[np.floating]

PLACE_SPACING_M = 0.04
SIDE_M = np.arange(0.02, 0.101, 0.02)
REACH_M = 0.06
HEIGHTS_M = np.linspace(-REACH_M, REACH_M, 25)
NEWTON_STEPS = 4
# A surface that runs along the seam instead of across it has no two sides.
MIN_ACROSS = 0.5


@dataclass(frozen=True)
class SeamJumps:
    """Jumps of the surface at all places where it crosses a seam.

    Attributes:
        seams: pairs of regions that the surface crosses between.
        places: points of the surface on seams, one every few centimetres.
        blended_m: (places,) of the map as it answers.
        nearest_m: (places,) where every point is answered by the nearest region alone.
    """

    seams: int
    places: int
    blended_m: NDArray[np.float64]
    nearest_m: NDArray[np.float64]

    def to_dict(self) -> dict[str, float]:
        """Medians and 90th percentiles for a report [m]; NaN without places."""
        summary = SeamSummary(
            self.seams,
            self.places,
            *(
                float(np.quantile(jumps, share)) if self.places else float("nan")
                for jumps in (self.blended_m, self.nearest_m)
                for share in (0.5, 0.9)
            ),
        )
        return asdict(summary)


@dataclass(frozen=True)
class SeamSummary:
    """Figures of `SeamJumps` [m]."""

    seams: int
    places: int
    blended_median_m: float
    blended_p90_m: float
    nearest_median_m: float
    nearest_p90_m: float


def seam_jumps(neural_map: NeuralMap) -> SeamJumps:
    """The jumps at all seams of a map."""
    seams, blended, nearest = 0, [np.empty(0)], [np.empty(0)]
    for first, second in _neighbours(neural_map):
        places = _places(neural_map, first, second)
        if not len(places.points):
            continue
        seams += 1
        with_blending = _jumps(places, lambda points: neural_map.values(points).distance)
        alone = _jumps(places, partial(_nearest_alone, places, first, second))
        # A place counts where both surfaces can be followed.
        known = np.isfinite(with_blending) & np.isfinite(alone)
        blended.append(with_blending[known])
        nearest.append(alone[known])
    joined = np.concatenate(blended), np.concatenate(nearest)
    return SeamJumps(seams, len(joined[0]), *joined)


@dataclass(frozen=True)
class _Places:
    """Where the surface crosses a seam.

    Attributes:
        points: (N, 3) map frame [m].
        normals: (N, 3) of the surface.
        across: (N, 3) unit vectors in the surface, from the first region to the second.
        middle, axis: (3,) of the seam: a point of it [m], and its normal.
        level: value of f on the surface.
    """

    points: Floats
    normals: Floats
    across: Floats
    middle: Floats
    axis: Floats
    level: float


def _neighbours(neural_map: NeuralMap) -> Iterator[tuple[PlacedRegion, PlacedRegion]]:
    for first, second in combinations(neural_map.regions, 2):
        steps = np.abs(np.subtract(first.stored.index, second.stored.index))
        if steps.sum() == 1:
            yield first, second


def _places(neural_map: NeuralMap, first: PlacedRegion, second: PlacedRegion) -> _Places:
    apart = second.center - first.center
    axis, middle = apart / np.linalg.norm(apart), 0.5 * (first.center + second.center)
    points = np.concatenate([first.observed_centers(True), second.observed_centers(True)])
    height = (points - middle) @ axis
    points = (points - height[:, None] * axis)[np.abs(height) < first.stored.mask.voxel_m]
    points = _one_a_cube(points, PLACE_SPACING_M)
    normals = np.empty((0, 3))
    for _ in range(NEWTON_STEPS):
        values, gradient = neural_map.gradient(points)
        within = gradient - (gradient @ axis)[:, None] * axis
        slope = np.sum(within * within, axis=1)
        step = (neural_map.surface_level - values.distance) / np.maximum(slope, 1e-6)
        good = np.isfinite(step) & (np.abs(step) * np.sqrt(slope) < REACH_M)
        points = points[good] + step[good, None] * within[good]
        length = np.maximum(np.linalg.norm(gradient[good], axis=1), 1e-6)
        normals = gradient[good] / length[:, None]
    across = axis - (normals @ axis)[:, None] * normals
    length = np.linalg.norm(across, axis=1)
    inside = _inside(first, points) & _inside(second, points)
    chosen = np.flatnonzero(inside & (length > MIN_ACROSS))
    chosen = chosen[_cube_firsts(points[chosen], PLACE_SPACING_M)]
    across = across[chosen] / length[chosen, None]
    level = neural_map.surface_level
    return _Places(points[chosen], normals[chosen], across, middle, axis, level)


def _inside(region: PlacedRegion, points: Floats) -> NDArray[np.bool_]:
    local = np.abs(region.to_local(points))
    return np.asarray((local < region.stored.half_side_m).all(axis=1), bool)


def _nearest_alone(
    places: _Places, first: PlacedRegion, second: PlacedRegion, points: Floats
) -> NDArray[np.float32]:
    """f (N,) of the region on whose side of the seam a point lies; NaN where it saw nothing."""
    values = np.full(len(points), np.nan, np.float32)
    beyond = (points - places.middle) @ places.axis > 0
    for region, side in ((first, ~beyond), (second, beyond)):
        local = region.to_local(points[side])
        answers = region.predict(local)[:, 0]
        values[side] = np.where(region.lookup(local) > 0, answers, np.nan)
    return values


def _jumps(
    places: _Places, distance: Callable[[Floats], NDArray[np.float32]]
) -> NDArray[np.float64]:
    """Jump (N,) at each place [m]; NaN where the surface cannot be followed on both sides."""
    along = np.concatenate([-SIDE_M[::-1], SIDE_M])
    samples = places.points[:, None] + along[:, None] * places.across[:, None]
    rays = samples[:, :, None] + HEIGHTS_M[:, None] * places.normals[:, None, None]
    values = distance(rays.reshape(-1, 3)).reshape(rays.shape[:3])
    heights = _crossings(values - places.level)
    count = len(SIDE_M)
    before = _continued(along[:count], heights[:, :count])
    after = _continued(along[count:], heights[:, count:])
    jumps: NDArray[np.float64] = np.abs(after - before)
    return jumps


def _crossings(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Height of the crossing nearest to 0 along the last axis [m]; NaN where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        crossing = (values[..., :-1] < 0) != (values[..., 1:] < 0)
        crossing &= np.isfinite(values[..., :-1]) & np.isfinite(values[..., 1:])
        share = values[..., :-1] / (values[..., :-1] - values[..., 1:])
        height = HEIGHTS_M[:-1] + share * np.diff(HEIGHTS_M)
    height = np.where(crossing, height, np.inf)
    nearest = np.abs(height).argmin(axis=-1)
    found = np.take_along_axis(height, nearest[..., None], -1)[..., 0]
    return np.where(np.isfinite(found), found, np.nan)


def _continued(along: Floats, heights: Floats) -> NDArray[np.float64]:
    """Height at 0 (N,) of straight lines through heights (N, S) at places (S,)."""
    design = np.stack([np.ones_like(along), along], axis=1)
    ends: NDArray[np.float64] = heights @ np.linalg.pinv(design)[0]
    return ends


def _one_a_cube(points: Floats, side_m: float) -> Floats:
    return points[_cube_firsts(points, side_m)]


def _cube_firsts(points: Floats, side_m: float) -> NDArray[np.intp]:
    """Rows of the first point in each cube of a lattice."""
    cubes = np.floor(points / side_m).astype(np.int64)
    return np.unique(cubes, axis=0, return_index=True)[1]
