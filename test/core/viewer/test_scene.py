"""The viewer's model, and what its panel says and takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from meslam_core.viewer.canvas import FREE_RGBA, OCCUPIED_RGBA, occupancy_image
from meslam_core.viewer.panel import status_html, within
from meslam_core.viewer.scene import Part, RegionBox, Scene, Status, Surface


def box(x: float) -> RegionBox:
    T_map_region = np.eye(4)
    T_map_region[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T_map_region[0, 3] = x
    return RegionBox((0, 0, 0), T_map_region, 2.0, 1000, 3)


def test_corners_of_a_box_differ_in_one_axis_a_bit() -> None:
    corners = box(5.0).corners
    assert np.allclose(corners.mean(axis=0), [5.0, 0.0, 0.0])
    assert np.allclose(corners[1] - corners[0], [0.0, 2.0, 0.0]), "the region's x axis"
    assert np.allclose(corners[4] - corners[0], [0.0, 0.0, 2.0])


def test_bounds_are_those_of_meshes_else_of_regions() -> None:
    scene = Scene()
    assert (scene.bounds[0] < 0).all()
    assert (scene.bounds[1] > 0).all()
    scene.regions.set((box(0.0), box(5.0)))
    assert np.allclose(scene.bounds, [[-1, -1, -1], [6, 1, 1]])
    corners = np.array([[0.0, 0, 0], [1, 2, 3]])
    scene.surfaces.set({(0, 0, 0): Surface(b"glTF", 9, corners, 1, 0.1)})
    assert np.allclose(scene.bounds, corners)
    scene.online_path.set(np.array([[0.0, 0, 0], [0, 7, 0]]))
    assert np.allclose(scene.bounds, [[0, 0, 0], [1, 7, 3]])


def test_a_part_counts_its_changes() -> None:
    part = Part(1)
    part.set(1)
    part.set(2)
    assert (part.value, part.revision) == (2, 2)


def test_density_needs_a_volume() -> None:
    assert Status(map_bytes=1000).bytes_per_m3 is None
    assert Status(map_bytes=1000, observed_volume_m3=4.0).bytes_per_m3 == 250.0


def test_the_panel_says_what_it_waits_for_and_no_more() -> None:
    scene = Scene()
    scene.status.set(Status(reason="<waits> for images"))
    text = status_html(scene)
    assert "WAITING" in text
    assert "&lt;waits&gt; for images" in text
    assert "<td" not in text


def test_the_panel_tells_the_figures() -> None:
    scene = Scene()
    scene.regions.set((box(0.0),))
    scene.status.set(Status("OK", "", 14.23, 100, 2, 31.4, 24_900, 10.0, 7))
    text = status_html(scene)
    for figure in ("OK", "14.2 frames/s", "31 ms", "100 tracked, 2 dropped", "24.9 kB", "10.0 m³"):
        assert figure in text
    assert "2,490 bytes/m³" in text


@pytest.mark.parametrize("value", [None, "7", [1.0], math.nan, math.inf, {}])
def test_what_is_no_number_is_not_taken_from_a_browser(value: object) -> None:
    assert within(value, (1.0, 2.0)) is None


def test_numbers_from_a_browser_are_brought_into_their_range() -> None:
    assert [within(value, (1.0, 2.0)) for value in (-5, 1.5, 1e9)] == [1.0, 1.5, 2.0]


def test_cells_are_coloured_by_what_is_known() -> None:
    image = occupancy_image(np.array([[-1, 0, 100]], np.int8))
    assert image.shape == (4, 12, 4)
    assert image[0, 0, 3] == 0
    assert tuple(image[0, 4]) == FREE_RGBA
    assert tuple(image[3, 11]) == OCCUPIED_RGBA
