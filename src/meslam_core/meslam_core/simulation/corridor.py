"""The scene `corridor`: a plain corridor round a block, with little texture to hold on to."""

from __future__ import annotations

import numpy as np

from meslam_core.simulation import textures
from meslam_core.simulation.path import Route, looking_ahead
from meslam_core.simulation.scene import Lamp, Patch, Scene, box, cylinder
from meslam_core.simulation.walls import Chamber, Wall

WIDTH_M, HEIGHT_M = 1.9, 2.5
OUTER = Chamber(0.0, 0.0, 12.0, 8.0, HEIGHT_M)

WAYPOINTS = (
    *((2.6, 0.95, 0), (4.6, 0.95, 12), (6.6, 1.0, -12), (8.6, 0.95, 0), (10.2, 1.05, 0)),
    *((10.95, 1.8, 0), (11.05, 3.2, 12), (11.05, 4.8, -12), (10.95, 6.2, 0), (10.2, 6.95, 0)),
    *((8.6, 7.05, 12), (6.6, 7.0, -12), (4.6, 7.05, 12), (3.0, 7.05, 0), (1.8, 6.95, 0)),
    *((1.05, 6.2, 0), (0.95, 4.8, -12), (0.95, 3.2, 12), (1.05, 1.8, 0), (1.7, 1.05, 0)),
)
"""x, y [m] and a glance to the left [degrees], once round the block."""


def corridor() -> Scene:
    """Build it: origin in a lower corner of the outer walls, x along the longer side, z up."""
    paint = textures.plaster((0.84, 0.84, 0.82), roughness=0.012)
    inner = _inner_walls()
    patches = [wall.face(paint, 0.004) for wall in (*_outer_walls(), *inner)]
    floor = textures.marbled((0.50, 0.52, 0.53), (0.46, 0.48, 0.49), 0.20)
    patches += OUTER.floor_and_ceiling(floor, textures.plaster((0.9, 0.9, 0.89), roughness=0.01))
    patches += _doors(_outer_walls(), 3.1, 0) + _doors(inner, 3.4, 1)
    patches += _fittings()
    lamps = [
        Lamp((x, y, HEIGHT_M - 0.08), 0.4, 3.0, 6.0)
        for x, y in ((2, 1), (6, 1), (10, 1), (11, 4), (10, 7), (6, 7), (2, 7), (1, 4))
    ]
    waypoints = np.array(WAYPOINTS) * (1, 1, np.pi / 180)
    route = Route(looking_ahead(waypoints), pace_m_s=0.55, most_hurry=1.1)
    return Scene("corridor", patches, lamps, ambient=0.6, route=route)


def _outer_walls() -> list[Wall]:
    return [OUTER.wall(side) for side in ("south", "east", "north", "west")]


def _inner_walls() -> list[Wall]:
    """The block's faces: what faces north from the block lies south of its corridor."""
    low_x, low_y = OUTER.west + WIDTH_M, OUTER.south + WIDTH_M
    high_x, high_y = OUTER.east - WIDTH_M, OUTER.north - WIDTH_M
    return [
        Wall((low_x, low_y), (1.0, 0.0), high_x - low_x, HEIGHT_M),
        Wall((high_x, low_y), (0.0, 1.0), high_y - low_y, HEIGHT_M),
        Wall((high_x, high_y), (-1.0, 0.0), high_x - low_x, HEIGHT_M),
        Wall((low_x, high_y), (0.0, -1.0), high_y - low_y, HEIGHT_M),
    ]


def _doors(walls: list[Wall], spacing: float, first: int) -> list[Patch]:
    """Closed doors with frames, and every wall's skirting."""
    frame, leaf = (
        textures.plaster((0.62, 0.64, 0.66), 0.01),
        textures.plaster((0.72, 0.66, 0.56), 0.015),
    )
    patches: list[Patch] = []
    for number, wall in enumerate(walls, first):
        patches += box(
            wall.point(wall.length_m / 2, 0.04, 0.006),
            (wall.length_m, 0.012, 0.08),
            frame,
            yaw=wall.yaw,
        )
        for along in np.arange(1.4 + 0.35 * (number % 3), wall.length_m - 1.2, spacing):
            patches += box(wall.point(along, 1.02, 0.01), (0.9, 0.02, 2.04), leaf, yaw=wall.yaw)
            for side in (-0.49, 0.49):
                post = wall.point(along + side, 1.05, 0.025)
                patches += box(post, (0.08, 0.05, 2.10), frame, yaw=wall.yaw)
            patches += box(
                wall.point(along, 2.08, 0.025), (0.9, 0.05, 0.08), frame, yaw=wall.yaw, without=()
            )
            handle = wall.point(along + 0.36, 1.02, 0.05)
            patches += box(handle, (0.13, 0.03, 0.03), frame, yaw=wall.yaw, without=())
    return patches


def _fittings() -> list[Patch]:
    """Radiators, extinguishers, a bench and a few notices."""
    south, east, north, west = _outer_walls()
    white, red = (
        textures.plaster((0.88, 0.88, 0.86), 0.01),
        textures.plaster((0.70, 0.16, 0.14), 0.02),
    )
    patches: list[Patch] = []
    for wall, along in ((south, 3.2), (east, 5.6), (north, 6.4), (west, 2.7)):
        patches += box(
            wall.point(along, 0.42, 0.08), (1.1, 0.10, 0.56), white, yaw=wall.yaw, without=()
        )
        patches.append(wall.hung(along + 0.9, 1.75, 0.30, 0.42, textures.poster(), 0.002, gap=0.01))
        patches += cylinder(wall.point(along - 1.0, 0.45, 0.12), 0.08, 0.5, red)
    seat = textures.wood((0.66, 0.56, 0.42), contrast=0.06)
    for wall, along in ((south, 8.6), (north, 9.4)):
        patches += box(
            wall.point(along, 0.43, 0.20), (1.4, 0.34, 0.04), seat, yaw=wall.yaw, without=()
        )
        for end in (-0.6, 0.6):
            patches += box(
                wall.point(along + end, 0.205, 0.20), (0.05, 0.30, 0.41), seat, yaw=wall.yaw
            )
    return patches
