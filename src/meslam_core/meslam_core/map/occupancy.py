"""A layer of the map as a two-dimensional occupancy grid for planners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.map.neural_map import FREE, OCCUPIED, UNKNOWN, NeuralMap

MAX_CELLS = 1 << 24
MAX_LEVELS = 1000
TILE_CELLS = 48
LEVELS_AT_ONCE = 8


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells seen from above, as in `nav_msgs/OccupancyGrid`.

    Attributes:
        cells: (H, W) int8, row y and column x: -1 unknown, 0 free, 100 occupied.
        origin: (2,) x and y of cell (0, 0)'s lower corner, map frame [m].
        resolution_m: side of a cell [m].
    """

    cells: NDArray[np.int8]
    origin: NDArray[np.float64]
    resolution_m: float


def occupancy_grid(
    neural_map: NeuralMap,
    min_height_m: float,
    max_height_m: float,
    resolution_m: float = 0.05,
    *,
    box: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
) -> OccupancyGrid:
    """Project the layer between two heights onto the map's xy plane.

    A cell is occupied when a surface passes through the layer above it, free when something of
    the layer was observed and nothing of it is occupied, else unknown. Equal heights give a
    slice as thick as a cell. Cells lie on multiples of the resolution.

    Args:
        neural_map: to ask.
        min_height_m: bottom of the layer, z of the map frame [m].
        max_height_m: top of the layer [m].
        resolution_m: side of a cell [m].
        box: lowest and highest x, y (2,) of the grid [m]; by default all that was observed.

    Raises:
        MapError: when the numbers make no sense or the grid would be too large.
    """
    if not 0.005 <= resolution_m <= 10.0:
        raise MapError(f"a grid resolution of {resolution_m} m is outside 0.005 to 10 m")
    if not max_height_m >= min_height_m:
        raise MapError(f"the layer from {min_height_m} to {max_height_m} m is upside down")
    levels = max(1, round((max_height_m - min_height_m) / resolution_m + 0.4999))
    low, high = neural_map.bounds[:, :2] if box is None else (np.asarray(c)[:2] for c in box)
    first = np.floor(low / resolution_m + 1e-6).astype(np.int64)
    width, height = np.ceil(high / resolution_m - 1e-6).astype(np.int64) - first
    if width <= 0 or height <= 0:
        raise MapError(f"the grid from {low} to {high} is empty; give the lowest corner first")
    if width * height > MAX_CELLS or levels > MAX_LEVELS:
        raise MapError(
            f"{width} x {height} cells of {levels} levels are too many; ask for a coarser "
            "resolution, a smaller box or a thinner layer"
        )
    middle = 0.5 * (min_height_m + max_height_m)
    steps = np.arange(levels) - 0.5 * (levels - 1)
    heights = np.asarray(middle + steps * resolution_m, np.float64)
    origin = np.asarray(first * resolution_m, np.float64)
    cells = np.full((int(height), int(width)), UNKNOWN)
    for row in range(0, int(height), TILE_CELLS):
        for column in range(0, int(width), TILE_CELLS):
            tile = cells[row : row + TILE_CELLS, column : column + TILE_CELLS]
            corner = first + np.array([column, row])
            tile[:] = _project(neural_map, corner, tile.shape, heights, resolution_m)
    return OccupancyGrid(cells, origin, resolution_m)


def _project(
    neural_map: NeuralMap,
    corner: NDArray[np.int64],
    shape: tuple[int, ...],
    heights: NDArray[np.float64],
    resolution_m: float,
) -> NDArray[np.int8]:
    """The cells (H, W) of one tile whose lowest cell has the lattice position `corner` (x, y)."""
    x = (corner[0] + np.arange(shape[1]) + 0.5) * resolution_m
    y = (corner[1] + np.arange(shape[0]) + 0.5) * resolution_m
    result = np.full(shape, UNKNOWN)
    low = np.array([x[0], y[0], heights[0]])
    high = np.array([x[-1], y[-1], heights[-1]])
    if not neural_map.touching(low, high):
        return result
    # Some levels at a time, so that memory does not grow with the layer's thickness; what has been
    # found occupied stays so.
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    states = result.reshape(-1)
    for start in range(0, len(heights), LEVELS_AT_ONCE):
        chosen = heights[start : start + LEVELS_AT_ONCE]
        open_cells = np.flatnonzero(states < OCCUPIED)
        points = np.empty((len(chosen), len(open_cells), 3))
        points[:, :, :2] = grid[open_cells]
        points[:, :, 2] = chosen[:, None]
        state = neural_map.occupancy(points.reshape(-1, 3), voxel_m=resolution_m)[0]
        highest = state.reshape(len(chosen), -1).max(axis=0)
        states[open_cells] = np.maximum(states[open_cells], highest)
    return result


assert UNKNOWN < FREE < OCCUPIED  # the projection takes the largest
