"""The scene `building`: eight furnished rooms on both sides of a corridor, 26 m by 11 m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meslam_core.simulation import building_rooms, textures
from meslam_core.simulation.furniture import OAK
from meslam_core.simulation.path import Route, looking_ahead
from meslam_core.simulation.scene import Lamp, Patch, Scene
from meslam_core.simulation.walls import Chamber, Opening

HEIGHT_M = 2.6
WALL_M = 0.15
LENGTH_M, DEPTH_M = 6.4, 4.4
"""Inner size of a room along the corridor and away from it."""

CORRIDOR = Chamber(0.0, 0.0, 4 * LENGTH_M + 3 * WALL_M, 2.2, HEIGHT_M)
TEXEL_SCALE = 1.7
"""Texels are longer than a single room's, for 130 m² of surface a room have to fit in memory."""

WAYPOINTS = (
    # Along the corridor.
    *((3.2, 1.1, 0), (4.8, 1.1, 0), (6.6, 1.2, 20), (8.7, 1.1, -20), (10.7, 1.0, -25)),
    *((12.8, 1.1, 20), (14.8, 1.2, 25), (16.9, 1.1, -20), (18.9, 1.0, -25), (21, 1.0, 0)),
    # Through the northern rooms, from east to west.
    *((22.8, 1.2, 10), (23.8, 2.2, 0), (23.9, 3.4, -25), (23.3, 4.7, -10), (21.7, 5.5, 20)),
    *((19.6, 5.6, 0), (18.1, 5.4, 25), (16.5, 4.6, 35), (14.9, 3.8, -20), (13, 3.6, 0)),
    *((11.4, 3.7, -30), (9.8, 4.4, -20), (8.2, 5.3, 30), (6.5, 5.6, 0), (5, 5.4, -25)),
    *((3.3, 5.0, -10), (2.2, 4.1, 15), (1.9, 3.0, 10)),
    # Along the corridor again.
    *((2, 2.0, 0), (2.9, 1.25, 0), (4.3, 1.0, 15), (6.4, 1.0, -20), (8.4, 1.1, -20)),
    *((10.5, 1.2, 25), (12.5, 1.1, 20), (14.6, 1.0, -20), (16.6, 1.1, -20), (18.7, 1.2, 20)),
    *((20.7, 1.2, 0),),
    # Through the southern rooms, from east to west, and back to the start.
    *((22.8, 1.0, -10), (23.8, 0.0, 0), (23.9, -1.2, 25), (23.3, -2.5, 10), (21.7, -3.3, -20)),
    *((19.6, -3.4, 0), (18.1, -3.2, -25), (16.5, -2.4, -35), (14.9, -1.6, 20), (13, -1.4, 0)),
    *((11.4, -1.5, 30), (9.8, -2.2, 20), (8.2, -3.1, -30), (6.5, -3.4, 0), (5, -3.2, 25)),
    *((3.3, -2.8, 10), (2.2, -1.9, -15), (1.8, -0.8, -10), (1.9, 0.2, 0), (2.4, 0.9, 0)),
)
"""x, y [m] and a glance to the left [degrees]: a figure of eight that shares the corridor."""

PAPERS = (
    textures.wallpaper((0.80, 0.78, 0.66), (0.44, 0.50, 0.38)),
    textures.plaster((0.62, 0.72, 0.78), roughness=0.05),
    textures.bricks((0.62, 0.36, 0.28)),
    textures.plaster((0.86, 0.80, 0.68), roughness=0.05),
    textures.wallpaper((0.70, 0.76, 0.82), (0.36, 0.40, 0.56), 0.30),
    textures.plaster((0.74, 0.80, 0.66), roughness=0.05),
    textures.bricks((0.72, 0.66, 0.58), (0.52, 0.50, 0.47)),
    textures.wallpaper((0.84, 0.72, 0.66), (0.58, 0.32, 0.30), 0.26),
)
FLOORS = (
    textures.planks((0.60, 0.44, 0.30)),
    textures.checker((0.72, 0.68, 0.60), (0.48, 0.46, 0.44), 0.30),
    textures.planks((0.48, 0.34, 0.24), 0.10, 0.9),
    textures.marbled((0.56, 0.58, 0.60), (0.40, 0.42, 0.46), 0.12),
)


def building() -> Scene:
    """Build it: origin in the corridor's south-western corner, x along the corridor, z up."""
    patches, lamps = _corridor()
    for number in range(8):
        room, openings = _room(number), _openings(number)
        patches += _shell(room, number, openings)
        patches += building_rooms.ROOMS[number](room)
        x, y = (room.west + room.east) / 2, (room.south + room.north) / 2
        lamps += [Lamp((x + dx, y, HEIGHT_M - 0.1), 0.5, 5.0, 6.0) for dx in (-1.3, 1.3)]
    patches = [replace(patch, texel_m=patch.texel_m * TEXEL_SCALE) for patch in patches]
    waypoints = np.array(WAYPOINTS, float) * (1, 1, np.pi / 180)
    route = Route(looking_ahead(waypoints), pace_m_s=0.70, most_hurry=1.06)
    return Scene("building", patches, lamps, ambient=0.5, route=route)


def _room(number: int) -> Chamber:
    """Rooms 0 to 3 lie north of the corridor, 4 to 7 south of it, each row from west to east."""
    west = (number % 4) * (LENGTH_M + WALL_M)
    south = CORRIDOR.north + WALL_M if number < 4 else CORRIDOR.south - WALL_M - DEPTH_M
    return Chamber(west, south, west + LENGTH_M, south + DEPTH_M, HEIGHT_M)


def _openings(number: int) -> dict[str, list[Opening]]:
    """A room's doorways by wall: to its neighbours, and to the corridor at the row's ends."""
    room, place = _room(number), number % 4
    # The doors between rooms lie alternately far from the corridor and near it.
    aside = {0: 3.25, 1: 1.25, 2: 3.25}
    result: dict[str, list[Opening]] = {side: [] for side in ("south", "north", "west", "east")}
    for side, neighbour in (("west", place - 1), ("east", place)):
        if neighbour in aside:
            away = aside[neighbour]
            y = room.south + away if number < 4 else room.north - away
            along = y - room.south if side == "west" else room.north - y
            result[side].append(Opening(along - 0.5))
    if place in (0, 3):
        x = 1.85 if place == 0 else 23.8
        if number < 4:
            result["south"].append(Opening(room.east - x - 0.5))
        else:
            result["north"].append(Opening(x - room.west - 0.5))
    return result


def _shell(room: Chamber, number: int, openings: dict[str, list[Opening]]) -> list[Patch]:
    """Walls with doorways, floor and ceiling of a room; each doorway is built once."""
    frame, sill = textures.wood((0.86, 0.80, 0.70), contrast=0.12), textures.wood(OAK)
    patches = []
    for turn, (side, holes) in enumerate(openings.items()):
        paper = PAPERS[(3 * number + turn) % len(PAPERS)]
        patches.append(room.wall(side).face(paper, 0.003, holes))
        if side != "east":
            for hole in holes:
                patches += room.wall(side).doorway(hole, WALL_M, frame, sill, 0.003)
    ceiling = textures.checker((0.86, 0.86, 0.84), (0.78, 0.78, 0.77), 0.6)
    return patches + room.floor_and_ceiling(FLOORS[number % len(FLOORS)], ceiling)


def _corridor() -> tuple[list[Patch], list[Lamp]]:
    """The corridor's shell, furniture and lamps."""
    holes: dict[str, list[Opening]] = {side: [] for side in ("south", "north", "west", "east")}
    for x in (1.85, 23.8):
        holes["north"].append(Opening(x - 0.5))
        holes["south"].append(Opening(CORRIDOR.east - x - 0.5))
    patches = []
    for turn, (side, openings) in enumerate(holes.items()):
        paper = PAPERS[(3, 1, 4, 0)[turn]]
        patches.append(CORRIDOR.wall(side).face(paper, 0.003, openings))
    ceiling = textures.checker((0.86, 0.86, 0.84), (0.76, 0.76, 0.75), 0.6)
    patches += CORRIDOR.floor_and_ceiling(
        textures.checker((0.62, 0.56, 0.48), (0.44, 0.40, 0.38), 0.4), ceiling
    )
    patches += building_rooms.corridor(CORRIDOR)
    return patches, [
        Lamp((x, 1.1, HEIGHT_M - 0.1), 0.4, 4.0, 6.0) for x in np.arange(2.2, 26.0, 4.3)
    ]
