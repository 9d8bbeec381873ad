"""Walls with doorways."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest

from meslam_core.simulation.path import Route
from meslam_core.simulation.renderer import scene_surface
from meslam_core.simulation.scene import Patch, Scene
from meslam_core.simulation.textures import checker
from meslam_core.simulation.walls import Chamber, Opening

TEXTURE = checker((0.2, 0.2, 0.2), (0.8, 0.8, 0.8), 0.1)
CHAMBER = Chamber(1.0, 2.0, 5.0, 5.0, 2.5)
INSIDE = (3.0, 3.5, 1.25)


def caster(patches: list[Patch]) -> o3d.t.geometry.RaycastingScene:
    result = o3d.t.geometry.RaycastingScene()
    mesh = scene_surface(Scene("test", patches, route=Route(np.zeros((1, 5)))))
    result.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return result


def hit(patches: list[Patch], start, direction) -> float:
    rays = o3d.core.Tensor.from_numpy(np.array([[*start, *direction]], np.float32))
    return float(caster(patches).cast_rays(rays)["t_hit"].numpy()[0])


def normals(patch: Patch) -> np.ndarray:
    corners = patch.vertices[patch.triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("side", ["south", "north", "west", "east"])
def test_walls_face_the_room_and_furniture_does_too(side):
    wall = CHAMBER.wall(side)
    patch = wall.face(TEXTURE, 0.01, [Opening(0.5)])
    inward = np.subtract(INSIDE, patch.vertices.mean(axis=0))
    assert (normals(patch) @ inward > 0).all()
    position, yaw = CHAMBER.against(side, 1.0, 0.4)
    front = np.array([np.sin(yaw), -np.cos(yaw)])
    assert front @ inward[:2] > 0
    assert CHAMBER.west < position[0] < CHAMBER.east
    assert CHAMBER.south < position[1] < CHAMBER.north
    start = (*position, 1.0)
    assert hit([wall.face(TEXTURE, 0.01)], start, (*-front, 0)) == pytest.approx(0.23)


def test_an_opening_lets_through_what_the_rest_of_the_wall_stops():
    wall = CHAMBER.wall("south").face(TEXTURE, 0.01, [Opening(1.0, 1.0, 2.1)])
    # The southern wall's left edge is the eastern one: the doorway spans x from 3 to 4.
    for x, z, stopped in (
        (3.5, 1.0, False),
        (3.05, 2.05, False),
        (3.5, 2.2, True),
        (2.95, 1.0, True),
        (4.05, 1.0, True),
    ):
        distance = hit([wall], (x, 3.0, z), (0, -1, 0))
        assert np.isfinite(distance) == stopped
    corners = wall.vertices[wall.triangles]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert area.sum() == pytest.approx(4.0 * 2.5 - 1.0 * 2.1)


def test_texture_runs_on_over_the_whole_wall():
    wall = CHAMBER.wall("north").face(TEXTURE, 0.01, [Opening(1.0)])
    along = wall.vertices[:, 0] - CHAMBER.west
    np.testing.assert_allclose(wall.coordinates[:, 0], along)
    np.testing.assert_allclose(wall.coordinates[:, 1], CHAMBER.height_m - wall.vertices[:, 2])


def test_a_doorway_leaves_no_gap_between_two_rooms():
    neighbour = Chamber(1.0, -1.2, 5.0, 1.8, 2.5)
    door = Opening(1.0)
    wall = CHAMBER.wall("south")
    patches = [
        wall.face(TEXTURE, 0.01, [door]),
        neighbour.wall("north").face(TEXTURE, 0.01, [Opening(2.0)]),
        *wall.doorway(door, 0.2, TEXTURE, TEXTURE, 0.01),
    ]
    for room, blind in ((CHAMBER, "south"), (neighbour, "north")):
        patches += room.floor_and_ceiling(TEXTURE, TEXTURE)
        patches += [
            room.wall(side).face(TEXTURE, 0.01)
            for side in ("south", "north", "west", "east")
            if side != blind
        ]
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    for start in ((3.5, 1.9, 1.2), INSIDE, (3.5, 1.0, 0.5)):
        rays = np.concatenate([np.tile(start, (4000, 1)), directions], 1).astype(np.float32)
        distance = caster(patches).cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
        ends = start + distance[:, None] * directions
        assert np.isfinite(distance).all()
        assert (ends.min(axis=0) > (0.99, -1.21, -0.01)).all()
        assert (ends.max(axis=0) < (5.01, 5.01, 2.51)).all()
    assert hit(patches, (3.5, 4.0, 1.2), (0, -1, 0)) == pytest.approx(5.2)
