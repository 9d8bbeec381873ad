"""Jumps of the surface where one region takes over from the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored

from meslam_core.evaluation.region_error import (
    RegionError,
    RegionVisits,
    error_at,
    fitted,
    in_box,
    region_error,
)
from meslam_core.evaluation.seams import seam_jumps
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.stored_region import StoredRegion

SCENE = SphereInRoom()
SHIFT_M = 0.02


@pytest.fixture(scope="module")
def regions() -> list[StoredRegion]:
    """The room in two regions that continue each other exactly."""
    x, y, z = GRID.center((1, 0, 0))
    return [stored(learnt_field(), SCENE), stored(learnt_field(), SCENE, (1, 0, 0), (x, y, z))]


def shifted(region: StoredRegion) -> StoredRegion:
    """The region beside its place, across the walls that cross the seam."""
    T_map_region = region.T_map_region.copy()
    T_map_region[1:3, 3] += SHIFT_M
    return replace(region, T_map_region=T_map_region)


def test_regions_that_continue_each_other_have_no_seam(regions):
    jumps = seam_jumps(NeuralMap(regions))
    assert jumps.seams == 1
    assert jumps.places > 50
    figures = jumps.to_dict()
    assert figures["nearest_median_m"] < 0.003
    assert figures["blended_median_m"] < 0.003


def test_a_jump_is_measured_as_it_is_and_blending_spreads_it(regions):
    figures = seam_jumps(NeuralMap([regions[0], shifted(regions[1])])).to_dict()
    assert figures["nearest_median_m"] == pytest.approx(SHIFT_M, abs=0.004)
    assert figures["blended_median_m"] < 0.5 * SHIFT_M


def test_a_map_of_one_region_has_no_seams(regions):
    jumps = seam_jumps(NeuralMap(regions[:1]))
    assert (jumps.seams, jumps.places) == (0, 0)
    assert np.isnan(jumps.to_dict()["blended_median_m"])


def wall_points() -> np.ndarray:
    """Points of the room's walls."""
    points = np.random.default_rng(0).uniform(-1.3, 1.3, (3000, 3))
    points[np.arange(3000), np.arange(3000) % 3] = SCENE.wall_m * np.sign(points[:, 0])
    return points


def test_a_regions_error_is_its_distance_from_the_true_surface(regions):
    exact = region_error(PlacedRegion(regions[0], "auto"), wall_points())
    moved = region_error(PlacedRegion(shifted(regions[0]), "auto"), wall_points())
    assert exact.points > 2000
    assert exact.median_m < 0.003
    # A third of the walls moved within themselves.
    assert moved.mean_m == pytest.approx(SHIFT_M * 2 / 3, abs=0.004)


def test_what_a_region_never_saw_does_not_count(regions):
    error = region_error(
        PlacedRegion(regions[0], "auto"), wall_points() + np.array([5.0, 0.0, 0.0])
    )
    assert error.points == 0
    assert np.isnan(error.median_m)


def test_the_same_points_count_wherever_a_region_was_moved_to(regions):
    region, points = PlacedRegion(regions[0], "auto"), wall_points()
    seen = points[in_box(region, points)]
    assert 2000 < len(seen) <= len(points)
    assert not in_box(region, points + 5.0).any()
    assert in_box(region, points, observed_only=False).all()
    moved = error_at(PlacedRegion(shifted(regions[0]), "auto"), seen)
    assert moved.points == len(seen)
    assert error_at(region, seen).mean_m < moved.mean_m


def test_where_a_region_lies_is_no_error_of_its_map(regions):
    points = wall_points()
    exact = error_at(PlacedRegion(regions[0], "auto"), points)
    elsewhere = PlacedRegion(shifted(regions[0]), "auto")
    assert error_at(elsewhere, points).mean_m > 3 * exact.mean_m
    moved = fitted(elsewhere, points)
    assert error_at(elsewhere, moved).mean_m == pytest.approx(exact.mean_m, abs=5e-4)
    # Rigidly: no point has come nearer to another.
    before, after = (np.linalg.norm(p[1:] - p[:-1], axis=1) for p in (points, moved))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_visits_tell_how_a_map_was_left_and_found_again():
    asked = []

    def error(region):
        asked.append(region)
        return RegionError(1, float(len(asked)), 0.0)

    visits = RegionVisits(error)
    home, first, second = (0, 0, 0), (1, 0, 0), (2, 0, 0)
    for region in (home, home, first, second, first, second, home, first):
        visits.follow(region)
    back = [visit for visit in visits.visits if visit.region == home][1]
    assert back.others == 2
    assert visits.visits[0].others == -1
    assert visits.visits[0].error_when_left.median_m == 1.0
    assert back.error_at_return.median_m < back.error_when_left.median_m
