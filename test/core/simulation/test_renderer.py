"""Exact views: known depth, known colours, filtering."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meslam_core.camera import PinholeCamera
from meslam_core.simulation import renderer
from meslam_core.simulation.canvas import Canvas
from meslam_core.simulation.renderer import Renderer
from meslam_core.simulation.scene import Lamp, Patch, Scene, box, quad
from meslam_core.simulation.textures import checker, plaster, poster

CAMERA = PinholeCamera(64, 48, 60.0, 62.0, 31.0, 24.5)
GREY = (0.5, 0.5, 0.5)


def looking_along_y() -> np.ndarray:
    """Camera at the origin: x to the right, image down = -z, optical axis = +y."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    return pose


def wall(distance: float, texture, side: float = 8.0, texel_m: float = 0.01) -> Patch:
    corner = (-side / 2, distance, side / 2)
    return quad(corner, (side, 0, 0), (0, 0, -side), texture, texel_m)


def test_plane_has_its_distance_as_depth_everywhere():
    view = Renderer(Scene("plane", [wall(2.0, plaster(GREY))])).render(CAMERA, looking_along_y())
    np.testing.assert_allclose(view.depth_m, 2.0, atol=1e-5)
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    slant = np.hypot((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy)
    np.testing.assert_allclose(view.incidence, 1 / np.hypot(1, slant), atol=1e-5)


def test_box_appears_where_it_projects():
    scene = Scene(
        "box", [wall(3.0, plaster(GREY)), *box((0.5, 2.0, 0.25), (0.4, 0.2, 0.3), plaster(GREY))]
    )
    view = Renderer(scene).render(CAMERA, looking_along_y())
    front = 1.9
    columns = np.flatnonzero((np.abs(view.depth_m - front) < 1e-4).any(axis=0))
    rows = np.flatnonzero((np.abs(view.depth_m - front) < 1e-4).any(axis=1))
    expected_u = CAMERA.cx + CAMERA.fx * np.array([0.3, 0.7]) / front
    expected_v = CAMERA.cy - CAMERA.fy * np.array([0.4, 0.1]) / front
    np.testing.assert_allclose([columns[0] - 0.5, columns[-1] + 0.5], expected_u, atol=0.6)
    np.testing.assert_allclose([rows[0] - 0.5, rows[-1] + 0.5], expected_v, atol=0.6)


def test_nothing_has_no_depth():
    view = Renderer(Scene("far", [wall(2.0, plaster(GREY), side=0.5)])).render(
        CAMERA, looking_along_y()
    )
    assert view.depth_m[0, 0] == 0
    assert view.color[0, 0].sum() == 0
    assert view.depth_m[24, 31] == pytest.approx(2.0, abs=1e-5)


def test_texture_lies_where_it_was_painted():
    """The checker's edges, every 0.4 m of the wall, fall on their projections."""
    scene = Scene("checker", [wall(2.0, checker((0, 0, 0), (1, 1, 1), 0.4))])
    camera = PinholeCamera(400, 60, 300.0, 300.0, 199.5, 29.5)
    row = Renderer(scene).render(camera, looking_along_y()).color[15, :, 0]
    bright = row > 0.5 * row.max()
    edges = np.flatnonzero(bright[1:] != bright[:-1]) + 0.5
    # Tiles of 0.4 m with edges at odd multiples of 0.2 m from the wall's left side.
    positions = np.arange(-4 + 0.2, 4, 0.4)
    expected = camera.cx + camera.fx * positions / 2.0
    expected = expected[(expected > 1) & (expected < 398)]
    np.testing.assert_allclose(edges, expected, atol=1.0)


def test_fine_texture_far_away_turns_grey_instead_of_shimmering():
    scene = Scene("far checker", [wall(7.0, checker((0, 0, 0), (1, 1, 1), 0.02), texel_m=0.005)])
    camera = PinholeCamera(64, 48, 100.0, 100.0, 31.5, 23.5)
    color = Renderer(scene).render(camera, looking_along_y()).color[10:38, 10:54, 0]
    assert color.std() < 0.05 * color.mean()


def test_edge_pixels_blend_both_sides():
    dark = box((0.0, 1.0, 0.0), (0.2, 0.02, 0.2), plaster((0.05, 0.05, 0.05)), yaw=0.3)
    scene = Scene("edge", [wall(2.0, plaster((0.9, 0.9, 0.9))), *dark])
    color = Renderer(scene).render(CAMERA, looking_along_y()).color[:, :, 0]
    between = (color > 0.3 * color.max()) & (color < 0.7 * color.max())
    assert between.any()


def test_texture_shows_the_same_at_other_resolutions():
    images = [
        poster()(Canvas(0.6, 0.9, rows, rows * 2 // 3, np.random.default_rng(4)))
        for rows in (450, 150)
    ]
    coarse = images[0].reshape(150, 3, 100, 3, 3).mean(axis=(1, 3))
    assert np.abs(coarse - images[1]).mean() < 0.03


def test_lamp_casts_a_shadow():
    floor = quad((-2, 2, 0), (4, 0, 0), (0, -4, 0), plaster(GREY, roughness=0.0), 0.02)
    table = box((0, 0, 0.5), (1.0, 1.0, 0.04), plaster(GREY, roughness=0.0), without=())
    scene = Scene("table", [floor, *table], [Lamp((0, 0, 2.0), 0.3, 3.0)], ambient=0.1)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1, -1, -1])
    pose[:3, 3] = (1.3, 0, 0.45)
    camera = PinholeCamera(200, 50, 50.0, 50.0, 99.5, 24.5)
    row = Renderer(scene).render(camera, pose).color[25, :, 0]
    x = 1.3 + (np.arange(200) - 99.5) / 50 * 0.45
    assert row[np.abs(x - 0.42).argmin()] < 0.7 * row[np.abs(x - 1.2).argmin()]


compiled = pytest.mark.skipif(renderer._kernel is None, reason="the kernel is not compiled")


def room_with_a_box() -> Renderer:
    """A wall that does not fill the view, a box before it, and a floor that begins behind."""
    floor = quad((-3.0, -2.0, -0.6), (6.0, 0, 0), (0, 6.0, 0), plaster(GREY), 0.01)
    tiles = wall(2.0, checker((0, 0.2, 0), (1, 1, 0.7), 0.03), side=1.5, texel_m=0.002)
    carton = box((0.3, 1.2, 0.1), (0.5, 0.3, 0.4), poster(), yaw=0.4, texel_m=0.004)
    return Renderer(Scene("room", [tiles, floor, *carton]))


def tilted() -> np.ndarray:
    """A camera that looks along y, down and to the side."""
    pose = looking_along_y()
    pose[:3, :3] = Rotation.from_euler("zx", (12, -17), degrees=True).as_matrix() @ pose[:3, :3]
    return pose


@compiled
@pytest.mark.parametrize("pose", [looking_along_y(), tilted()], ids=["straight", "tilted"])
def test_compiled_views_are_those_of_cast_rays(pose, monkeypatch: pytest.MonkeyPatch):
    room = room_with_a_box()
    view = room.render(CAMERA, pose)
    monkeypatch.setattr(renderer, "_kernel", None)
    reference = room.render(CAMERA, pose)
    assert (reference.depth_m == 0).any()
    # Another triangle at the outline of something is a rounding error away.
    same = np.abs(view.depth_m - reference.depth_m) < 1e-4
    assert same.mean() > 0.999
    np.testing.assert_allclose(view.incidence[same], reference.incidence[same], atol=1e-4)
    differs = np.abs(view.color - reference.color).max(axis=2)
    assert np.median(differs) < 1e-3
    assert np.mean(differs > 3) < 0.005


@compiled
def test_compiled_shading_is_that_of_numpy(monkeypatch: pytest.MonkeyPatch):
    room = room_with_a_box()
    hits = room._seen(CAMERA, tilted())
    colors = room._shade(hits, CAMERA)
    monkeypatch.setattr(renderer, "_kernel", None)
    reference = room._shade(hits, CAMERA)
    assert np.unique(reference.round()).size > 50
    np.testing.assert_allclose(colors, reference, atol=1e-3)


@compiled
def test_a_triangle_behind_beside_or_without_area_is_not_seen():
    behind = [[-1, -1, -2], [1, -1, -2], [0, 1, -2]]
    beside = [[9, -1, 2], [10, -1, 2], [9, 1, 2]]
    line = [[-1, -1, 2], [0, 0, 2], [1, 1, 2]]
    corners = np.array([behind, beside, line], float)
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 62.0, "cx": 31.0, "cy": 24.5}
    depth, _, _, cosine = renderer._kernel.seen_triangles(corners, **camera)
    assert np.isinf(depth).all()
    assert not cosine.any()


@compiled
def test_compiled_shading_refuses_what_would_lead_beyond_its_arrays():
    arrays = {
        "image": np.zeros((4, 4, 3), np.uint8),
        "levels": np.ones((3, 2), np.float32),
        "texels": np.ones((5, 7), np.float32),
        "distance": np.ones(1, np.float32),
        "triangle": np.array([4], np.uint32),
        "shares": np.full((1, 2), 1e9, np.float32),
        "cosine": np.ones(1, np.float32),
    }
    assert renderer._kernel.shade(**arrays, focal_px=1.0).shape == (1, 3)
    wrong = {
        "image": np.zeros((1, 4, 3), np.uint8),
        "levels": np.ones((2, 2), np.float32),
        "texels": np.ones((5, 6), np.float32),
        "distance": np.ones(2, np.float32),
        "triangle": np.array([5], np.uint32),
        "shares": np.ones((1, 3), np.float32),
        "cosine": np.ones(2, np.float32),
    }
    for name, array in wrong.items():
        with pytest.raises(ValueError, match=r".+"):
            renderer._kernel.shade(**{**arrays, name: array}, focal_px=1.0)
