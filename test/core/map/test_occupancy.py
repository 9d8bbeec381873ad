from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meslam_core.errors import MapError
from meslam_core.map.neural_map import FREE, OCCUPIED, UNKNOWN, NeuralMap
from meslam_core.map.occupancy import OccupancyGrid, OccupancyLayer, occupancy_grid
from meslam_core.map.stored_region import StoredRegion


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = ((np.array([x, y]) - grid.origin) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])


def test_a_slice_through_the_ball(neural_map: NeuralMap) -> None:
    grid = occupancy_grid(neural_map, 0.0, 0.0, 0.05)
    assert at(grid, 0.0, 0.0) == UNKNOWN
    assert at(grid, 0.47, 0.0) == OCCUPIED
    assert at(grid, 0.0, -0.47) == OCCUPIED
    assert at(grid, 0.9, -0.9) == FREE
    assert at(grid, 1.42, 0.3) == OCCUPIED


def test_a_layer_is_occupied_where_anything_in_it_is(neural_map: NeuralMap) -> None:
    above = occupancy_grid(neural_map, 0.7, 1.1, 0.05)
    assert at(above, 0.0, 0.0) == FREE
    layer = occupancy_grid(neural_map, -1.1, 1.1, 0.05)
    assert at(layer, 0.0, 0.0) == OCCUPIED
    assert at(layer, 0.47, 0.0) == OCCUPIED
    assert at(layer, 0.9, 0.9) == FREE


def test_the_floor_below_the_layer_does_not_count(neural_map: NeuralMap) -> None:
    assert at(occupancy_grid(neural_map, -1.3, -1.0, 0.05), 0.9, 0.9) == FREE
    assert at(occupancy_grid(neural_map, -1.45, -1.0, 0.05), 0.9, 0.9) == OCCUPIED


def test_rows_are_y_and_columns_are_x(neural_map: NeuralMap) -> None:
    box = (np.array([-1.5, 0.2]), np.array([1.5, 0.8]))
    grid = occupancy_grid(neural_map, 0.0, 0.2, 0.1, box=box)
    assert grid.cells.shape == (6, 30)
    assert np.allclose(grid.origin, [-1.5, 0.2])
    assert grid.cells.dtype == np.int8
    whole = occupancy_grid(neural_map, 0.0, 0.2, 0.1)
    for x, y in ((-1.45, 0.25), (0.45, 0.25), (1.05, 0.75)):
        assert at(grid, x, y) == at(whole, x, y)


def test_beyond_the_map_nothing_is_known(neural_map: NeuralMap) -> None:
    box = (np.array([5.0, 5.0]), np.array([6.0, 6.0]))
    assert (occupancy_grid(neural_map, 0.0, 1.0, 0.1, box=box).cells == UNKNOWN).all()


def test_a_layer_follows_a_map_that_grows_and_moves(
    region: StoredRegion, neighbour: StoredRegion
) -> None:
    T_map_moved = neighbour.T_map_region.copy()
    T_map_moved[:2, 3] += [0.6, -0.35]
    moved = replace(neighbour, T_map_region=T_map_moved, version=neighbour.version + 1)
    layer = OccupancyLayer(-0.3, 0.3, 0.05)
    for regions in ([region], [region, neighbour], [region, moved], [moved], [region]):
        neural_map = NeuralMap(regions)
        grid, anew = layer.update(neural_map), occupancy_grid(neural_map, -0.3, 0.3, 0.05)
        np.testing.assert_array_equal(grid.cells, anew.cells)
        np.testing.assert_allclose(grid.origin, anew.origin)
    assert layer.update(NeuralMap([region])) is grid


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 1.0, 0.0), "resolution"),
        ((1.0, 0.0, 0.1), "upside down"),
        ((float("nan"), 0.0, 0.1), "upside down"),
        ((0.0, 1e6, 0.1), "too many"),
    ],
)
def test_requests_without_sense(
    neural_map: NeuralMap, arguments: tuple[float, float, float], message: str
) -> None:
    with pytest.raises(MapError, match=message):
        occupancy_grid(neural_map, *arguments)


def test_grids_too_large_or_empty(neural_map: NeuralMap) -> None:
    with pytest.raises(MapError, match="too many"):
        occupancy_grid(neural_map, 0, 1, 0.01, box=(np.full(2, -500.0), np.full(2, 500.0)))
    with pytest.raises(MapError, match="empty"):
        occupancy_grid(neural_map, 0, 1, 0.1, box=(np.ones(2), np.zeros(2)))
