"""How far one region's map, asked alone, is from the true surface in its box, and over visits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from meslam_core.field.rendering import surface_level
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import OBSERVED
from meslam_core.se3 import exp

FIT_STEPS = 12
# Distances count in full up to the first and not at all from the second on [m].
FIT_HUBER_M, FIT_REACH_M = 0.02, 0.08
# Of the information that a point has at most; less than this a point is none.
FIT_DAMPING = 1e-2


@dataclass(frozen=True)
class RegionError:
    """Distance of the true surface in a region's box to the region's own surface.

    Attributes:
        points: of the true surface that count.
        median_m, mean_m: of their distances, each at most the truncation [m]; NaN without points.
    """

    points: int
    median_m: float
    mean_m: float

    def to_dict(self) -> dict[str, float]:
        """Plain numbers for a report."""
        return asdict(self)


def region_error(
    region: PlacedRegion, surface: NDArray[np.floating], observed_only: bool = True
) -> RegionError:
    """A region's error in its box, whatever other regions say of the same place.

    Args:
        region: ready to answer.
        surface: (N, 3) points of the true surface, map frame [m].
        observed_only: leave out what the region has not observed.
    """
    return error_at(region, surface[in_box(region, surface, observed_only)])


def in_box(
    region: PlacedRegion, surface: NDArray[np.floating], observed_only: bool = True
) -> NDArray[np.bool_]:
    """Which points (N,) of a surface (N, 3), map frame [m], lie in a region's box.

    Args:
        region: ready to answer.
        surface: as above.
        observed_only: leave out what the region has not observed.
    """
    local = region.to_local(surface)
    inside = np.asarray((np.abs(local) < region.stored.half_side_m).all(axis=1))
    if observed_only:
        inside[inside] = region.lookup(local[inside]) & OBSERVED > 0
    return inside


def error_at(region: PlacedRegion, surface: NDArray[np.floating]) -> RegionError:
    """A region's error at all given points (N, 3) of the true surface, map frame [m]."""
    if not len(surface):
        return RegionError(0, float("nan"), float("nan"))
    truncation_m = region.stored.architecture.truncation_m
    off = np.minimum(np.abs(_signed_distance(region, surface)[0]), truncation_m)
    return RegionError(len(surface), float(np.median(off)), float(off.mean()))


def fitted(region: PlacedRegion, surface: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points of the true surface (N, 3), map frame [m], moved rigidly onto a region's map.

    Where a region lies is a matter of the path; what remains after this is its map's own error.
    By Gauss-Newton on the field with Huber's weights, damped where the surface says next to
    nothing about a motion, as along a plain corridor.

    Args:
        region: ready to answer.
        surface: within a few centimetres of the region's.
    """
    moved = np.asarray(surface, np.float64)
    for _ in range(FIT_STEPS if len(moved) else 0):
        off, normals = _signed_distance(region, moved)
        off_m = np.maximum(np.abs(off), 1e-9)
        weights = np.minimum(FIT_HUBER_M / off_m, 1.0) * (off_m < FIT_REACH_M)
        center = moved.mean(axis=0)
        jacobian = np.concatenate([normals, np.cross(moved - center, normals)], axis=1)
        information = (jacobian * weights[:, None]).T @ jacobian
        information += FIT_DAMPING * len(moved) * np.eye(6)
        motion = exp(-np.linalg.solve(information, (jacobian * weights[:, None]).T @ off))
        moved = (moved - center) @ motion[:3, :3].T + motion[:3, 3] + center
    return moved


def _signed_distance(
    region: PlacedRegion, surface: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance (N,) of points, map frame, to a region's surface [m], and its gradient (N, 3)."""
    architecture = region.stored.architecture
    values, gradient = region.gradient(region.to_local(surface))
    # Where f has saturated its slope tells nothing.
    slope = np.maximum(np.linalg.norm(gradient, axis=1), 0.125 / architecture.truncation_m)
    level = surface_level(architecture.field_config())
    return (values[:, 0] - level) / slope, gradient / slope[:, None]


@dataclass
class Visit:
    """From when a region begins to work until another one takes over.

    Attributes:
        region: its place on the lattice.
        others: different regions that worked since it was left last; -1 at the first visit.
        error_at_return, error_when_left: of its map; None where not measured.
    """

    region: RegionIndex
    others: int = -1
    error_at_return: RegionError | None = None
    error_when_left: RegionError | None = None


@dataclass
class RegionVisits:
    """Follows which region works, and measures its map whenever that changes.

    Args:
        error: of the map of a region as it is at the moment.

    Attributes:
        visits: so far; the last one goes on.
    """

    error: Callable[[RegionIndex], RegionError]
    visits: list[Visit] = field(default_factory=list)

    def follow(self, working: RegionIndex) -> None:
        """Call after every frame, while nothing trains, with the region that works."""
        if self.visits and self.visits[-1].region == working:
            return
        if self.visits:
            self.visits[-1].error_when_left = self.error(self.visits[-1].region)
        before = [n for n, visit in enumerate(self.visits) if visit.region == working]
        visit = Visit(working)
        if before:
            visit.others = len({each.region for each in self.visits[before[-1] + 1 :]})
            visit.error_at_return = self.error(working)
        self.visits.append(visit)
