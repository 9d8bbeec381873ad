"""What the benchmark of a large scene makes of a path, a map, and the visits of regions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.map.neural_map import NeuralMap
from meslam_core.regions.grid import RegionGrid
from meslam_core.trajectory import Trajectory

# Of boxes that the camera hardly looked into nothing is said.
LEAST_POINTS = 200
# A region that is come back to after so many others.
MANY_OTHERS = 10


def path_m(truth: Trajectory) -> NDArray[np.float64]:
    """Length (N,) of the path up to each pose [m]."""
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def surface_errors(
    neural_map: NeuralMap, surface: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Distance (N,) of points of the true surface, map frame, to the map's [m], and what is known.

    It is at most the truncation, which also counts where nothing is known.
    """
    values, gradient = neural_map.gradient(surface)
    known = np.isfinite(values.distance)
    # Where f has saturated its slope tells nothing.
    slope = np.maximum(np.linalg.norm(gradient, axis=1), 0.125 / neural_map.truncation_m)
    off = np.abs(values.distance - neural_map.surface_level) / slope
    return np.where(known, np.minimum(off, neural_map.truncation_m), neural_map.truncation_m), known


def by_box(
    errors: NDArray[np.float64], surface: NDArray[np.floating], grid: RegionGrid
) -> dict[tuple[int, int, int], float]:
    """Median error in each box of the lattice that holds enough of the surface.

    Args:
        errors: (N,) [m].
        surface: (N, 3) map frame [m]; a point belongs to the box whose centre is nearest.
        grid: the lattice.
    """
    boxes = np.rint((surface - grid.origin) / grid.spacing_m).astype(int)
    found: dict[tuple[int, int, int], float] = {}
    for box in np.unique(boxes, axis=0):
        inside = (boxes == box).all(axis=1)
        if np.count_nonzero(inside) >= LEAST_POINTS:
            found[tuple(box.tolist())] = float(np.median(errors[inside]))
    return found


def revisits(visits: list[dict[str, Any]], others: int = MANY_OTHERS) -> list[dict[str, Any]]:
    """What became of the maps of regions that were come back to after at least so many others.

    Returns:
        For each: the region, how many others worked meanwhile, and the median errors of its map
        [m] when it was left, when it was come back to, and when it was left again (None where the
        run ended before).
    """
    found = []
    last: dict[tuple[int, ...], dict[str, Any] | None] = {}
    for visit in visits:
        region = tuple(visit["region"])
        left = last.get(region)
        if visit["others"] >= others and left and left["median_m"] is not None:
            found.append(
                {
                    "region": list(region),
                    "others": visit["others"],
                    "left_m": left["median_m"],
                    "return_m": _median(visit["error_at_return"]),
                    "left_again_m": _median(visit["error_when_left"]),
                }
            )
        last[region] = visit["error_when_left"]
    return found


def _median(error: dict[str, Any] | None) -> float | None:
    return error["median_m"] if error else None


def memory_over_path(
    peak_mb: NDArray[np.floating], along_m: NDArray[np.floating]
) -> dict[str, float]:
    """The peak at a third of the path and at its end [MB], and the growth in between."""
    third = float(peak_mb[np.searchsorted(along_m, along_m[-1] / 3.0)])
    end = float(peak_mb[-1])
    return {"third_mb": third, "end_mb": end, "growth": end / third - 1.0}
