"""A layer of the map as a two-dimensional occupancy grid for planners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.map.neural_map import FREE, OCCUPIED, UNKNOWN, NeuralMap
from meslam_core.regions.grid import RegionIndex

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

    @property
    def corner(self) -> NDArray[np.float64]:
        """x and y (2,) of the last cell's upper corner, map frame [m]."""
        return self.origin + self.resolution_m * np.array(self.cells.shape[::-1])


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
    first, (height, width) = _extent(low, high, resolution_m)
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
    cells = np.full((height, width), UNKNOWN)
    for row in range(0, height, TILE_CELLS):
        for column in range(0, width, TILE_CELLS):
            tile = cells[row : row + TILE_CELLS, column : column + TILE_CELLS]
            corner = first + np.array([column, row])
            tile[:] = _project(neural_map, corner, tile.shape, heights, resolution_m)
    return OccupancyGrid(cells, origin, resolution_m)


class OccupancyLayer:
    """A layer's grid that follows a map: only where regions have changed or moved is asked anew.

    Args:
        min_height_m, max_height_m, resolution_m: as of `occupancy_grid`.
    """

    def __init__(self, min_height_m: float, max_height_m: float, resolution_m: float) -> None:
        self._numbers = (min_height_m, max_height_m, resolution_m)
        self._known: dict[RegionIndex, tuple[int, NDArray[np.float64]]] = {}
        self._grid: OccupancyGrid | None = None

    def update(self, neural_map: NeuralMap) -> OccupancyGrid:
        """The grid of all that was observed, as the map is now.

        Raises:
            MapError: when nothing was observed, or the grid would be too large.
        """
        regions = {r.stored.index: (r.stored.version, r.bounds) for r in neural_map.regions}
        changed = []
        for index in regions.keys() | self._known.keys():
            entries = [known[index] for known in (regions, self._known) if index in known]
            versions = {(version, bounds.tobytes()) for version, bounds in entries}
            if len(entries) < 2 or len(versions) > 1:
                changed += [bounds[:, :2] for _, bounds in entries]
        if self._grid is None:
            self._grid = occupancy_grid(neural_map, *self._numbers)
        elif changed:
            self._grid = self._renewed(self._grid, neural_map, changed)
        self._known = regions
        return self._grid

    def _renewed(
        self, known: OccupancyGrid, neural_map: NeuralMap, boxes: list[NDArray[np.float64]]
    ) -> OccupancyGrid:
        """The grid with what lies in some boxes (2, 2) asked anew."""
        resolution_m = self._numbers[2]
        lowest, highest = neural_map.bounds[:, :2]
        first, shape = _extent(lowest, highest, resolution_m)
        origin = np.asarray(first * resolution_m, np.float64)
        grid = OccupancyGrid(np.full(shape, UNKNOWN), origin, resolution_m)
        _paste(known, grid)
        for low, high in boxes:
            low, high = np.maximum(low, grid.origin), np.minimum(high, grid.corner)
            if (high - low > 1e-6).all():
                _paste(occupancy_grid(neural_map, *self._numbers, box=(low, high)), grid)
        return grid


def _extent(
    low: NDArray[np.floating], high: NDArray[np.floating], resolution_m: float
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Lattice position (x, y) of the lowest cell between two corners (2,), and the shape (H, W)."""
    first = np.floor(low / resolution_m + 1e-6).astype(np.int64)
    width, height = np.ceil(high / resolution_m - 1e-6).astype(np.int64) - first
    return first, (int(height), int(width))


def _paste(source: OccupancyGrid, target: OccupancyGrid) -> None:
    """Copy the cells that two grids of one resolution have in common."""
    column, row = np.rint((source.origin - target.origin) / target.resolution_m).astype(int)
    (height, width), (rows, columns) = target.cells.shape, source.cells.shape
    top, bottom = max(row, 0), min(row + rows, height)
    left, right = max(column, 0), min(column + columns, width)
    if top < bottom and left < right:
        part = source.cells[top - row : bottom - row, left - column : right - column]
        target.cells[top:bottom, left:right] = part


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
