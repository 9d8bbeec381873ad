"""The lattice of overlapping boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meslam_core.config import RegionsConfig
from meslam_core.regions.grid import RegionGrid

GRID = RegionGrid.around(np.array([0.4, -1.0, 0.2]), RegionsConfig())
positions = st.tuples(*[st.floats(-30, 30)] * 3).map(np.array)


def test_a_box_has_the_volume_asked_for_and_the_first_is_about_the_first_position():
    assert GRID.side_m**3 == pytest.approx(30.0)
    np.testing.assert_allclose(GRID.center((0, 0, 0)), [0.4, -1.0, 0.2])


def test_neighbours_overlap_by_their_share():
    left, right = GRID.center((0, 0, 0))[0], GRID.center((1, 0, 0))[0]
    shared = (left + GRID.side_m / 2) - (right - GRID.side_m / 2)
    assert shared == pytest.approx(0.2 * GRID.side_m)


@given(positions)
def test_every_position_lies_in_the_box_that_is_nearest(position):
    assert GRID.nearest(position) in GRID.containing(position)


@given(positions)
def test_containing_boxes_are_exactly_those_that_contain(position):
    containing = GRID.containing(position)
    assert 1 <= len(containing) <= 8
    near = GRID.nearest(position)
    for step in np.ndindex(3, 3, 3):
        index = tuple(int(n + s - 1) for n, s in zip(near, step, strict=True))
        reach = np.abs(position - GRID.center(index)).max()
        if abs(reach - GRID.side_m / 2) > 1e-9:
            assert (reach < GRID.side_m / 2) == (index in containing)


@given(positions)
def test_the_distance_past_the_middle_is_negative_exactly_where_the_box_is_nearest(position):
    near = GRID.nearest(position)
    assert GRID.distance_past_middle(position, near) <= 1e-9
    for other in GRID.containing(position):
        if other != near:
            assert GRID.distance_past_middle(position, other) >= -1e-9


def test_the_middle_of_an_intersection_is_halfway_between_the_centres():
    middle = 0.5 * (GRID.center((0, 0, 0)) + GRID.center((1, 0, 0)))
    for index in ((0, 0, 0), (1, 0, 0)):
        assert GRID.distance_past_middle(middle, index) == pytest.approx(0.0, abs=1e-9)
    past = middle + np.array([0.1, 0.0, 0.0])
    assert GRID.distance_past_middle(past, (0, 0, 0)) == pytest.approx(0.1)
    assert sorted(GRID.containing(middle)) == [(0, 0, 0), (1, 0, 0)]


def test_a_corner_belongs_to_eight_boxes():
    corner = GRID.center((0, 0, 0)) + 0.5 * GRID.spacing_m
    assert len(GRID.containing(corner)) == 8
