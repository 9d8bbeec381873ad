from __future__ import annotations

import numpy as np
import pytest
from data.analytic_scene import SphereInRoom

from meslam_core.errors import MapError
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.surface import MapSurfaces, surface_points


@pytest.fixture(scope="module")
def surfaces(neural_map: NeuralMap) -> MapSurfaces:
    return MapSurfaces(neural_map)


def test_points_lie_on_the_surface(surfaces: MapSurfaces, scene: SphereInRoom) -> None:
    points = surfaces.points()
    error = np.abs(scene.distance_m(points.positions.astype(float)))
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.99) < 0.02
    truth = scene.color(points.positions.astype(float)) * 255
    assert np.median(np.abs(points.colors - truth)) < 6
    ahead = scene.distance_m(points.positions + 0.03 * points.normals)
    assert (ahead > 0).mean() > 0.99


def test_points_are_spaced_and_leave_no_gaps(surfaces: MapSurfaces) -> None:
    cubes = np.floor(surfaces.points().positions / 0.04).astype(int)
    assert len(np.unique(cubes, axis=0)) == len(cubes)
    area_m2 = 6 * 2.8**2 + np.pi
    assert len(cubes) > 0.7 * area_m2 / 0.04**2


def test_distances_also_far_from_surfaces(surfaces: MapSurfaces, scene: SphereInRoom) -> None:
    points = np.random.default_rng(8).uniform(-1.35, 1.35, (1000, 3))
    points = points[scene.distance_m(points) > 0.0]
    error = np.abs(surfaces.distance_m(points) - scene.distance_m(points))
    assert np.median(error) < 0.005
    assert error.max() < 0.04


def test_distances_outside_the_map(surfaces: MapSurfaces) -> None:
    assert surfaces.distance_m(np.array([[11.4, 0.0, 0.0]])) == pytest.approx(10.0, abs=0.03)


def test_spacings_without_sense(neural_map: NeuralMap) -> None:
    with pytest.raises(MapError, match="spacing"):
        surface_points(neural_map, 0.0)
