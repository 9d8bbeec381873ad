"""Furniture in its place: against a wall, hung on one, or with what belongs on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meslam_core.simulation import furniture, textures
from meslam_core.simulation.canvas import Color
from meslam_core.simulation.furniture import BIRCH
from meslam_core.simulation.scene import Patch, box, cylinder, sphere
from meslam_core.simulation.textures import Texture
from meslam_core.simulation.walls import Chamber

PLAID = textures.fabric((0.30, 0.38, 0.52), (0.78, 0.74, 0.62))
GREEN = textures.fabric((0.36, 0.46, 0.40), (0.46, 0.56, 0.48))
RED = textures.fabric((0.62, 0.26, 0.22), (0.84, 0.66, 0.42))
PILLOW = textures.rug((0.80, 0.62, 0.28), (0.32, 0.22, 0.20), (0.86, 0.82, 0.72))
RUG = textures.rug((0.55, 0.20, 0.18), (0.80, 0.70, 0.52), (0.18, 0.24, 0.38))
BLUE_RUG = textures.rug((0.22, 0.30, 0.46), (0.76, 0.74, 0.66), (0.60, 0.34, 0.20))


def pictures(room: Chamber, side: str, *frames: tuple[float, float, float, float]) -> list[Patch]:
    """Prints on a wall: middle from its left edge, upper edge, width and height [m]."""
    wall, poster = room.wall(side), textures.poster()
    return [
        wall.hung(middle - width / 2, top, width, height, poster, 0.002, gap=0.012)
        for middle, top, width, height in frames
    ]


def shelf(
    room: Chamber,
    side: str,
    along: float,
    width: float,
    height: float,
    seed: int,
    color: Color = BIRCH,
) -> list[Patch]:
    """A bookshelf against a wall."""
    position, yaw = room.against(side, along, 0.30)
    return furniture.bookshelf(position, yaw, (width, 0.30, height), seed, color)


def cupboard(room: Chamber, side: str, along: float, width: float, height: float) -> list[Patch]:
    """A cupboard against a wall."""
    position, yaw = room.against(side, along, 0.50)
    return furniture.wardrobe(position, yaw, (width, 0.50, height))


def couch(
    room: Chamber, side: str, along: float, cloth: Texture, width: float = 1.9
) -> list[Patch]:
    """A sofa against a wall."""
    position, yaw = room.against(side, along, 0.84)
    return furniture.sofa(position, yaw, width, cloth, PILLOW)


def workplace(room: Chamber, side: str, along: float, cloth: Texture, color: Color) -> list[Patch]:
    """A desk against a wall with a screen, books, a mug and a chair."""
    (x, y), yaw = room.against(side, along, 0.70)
    right = np.array([np.cos(yaw), np.sin(yaw)])
    front = np.array([np.sin(yaw), -np.cos(yaw)])
    desk = np.array([x, y])
    patches = furniture.table((x, y), yaw, (1.5, 0.7, 0.74), color)
    patches += furniture.monitor((*(desk - 0.12 * front), 0.74), yaw + 0.1)
    patches += furniture.chair(tuple(desk + 0.5 * front - 0.2 * right), yaw + np.pi + 0.3, cloth)
    patches += books(tuple(desk - 0.5 * right), 0.74, yaw)
    mug = textures.checker((0.20, 0.45, 0.60), (0.90, 0.88, 0.80), 0.03)
    cup = (*(desk + 0.45 * right + 0.1 * front), 0.74)
    return patches + cylinder(cup, 0.042, 0.10, mug, texel_m=0.0015)


def books(position: Sequence[float], level: float, yaw: float) -> list[Patch]:
    """A small stack of books."""
    faces = {"side": textures.book_spine(), "top": textures.poster()}
    patches: list[Patch] = []
    for index, (width, depth, turn) in enumerate(
        ((0.30, 0.22, 0.2), (0.26, 0.20, -0.1), (0.22, 0.16, 0.5))
    ):
        center = (position[0], position[1], level + 0.022 + 0.041 * index)
        patches += box(center, (width, depth, 0.04), faces, yaw=yaw + turn)
    return patches


def dining(position: tuple[float, float], yaw: float, cloth: Texture, color: Color) -> list[Patch]:
    """A table with four chairs and a bowl of fruit."""
    patches = furniture.table(position, yaw, (1.3, 0.8, 0.74), color)
    right, front = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
    for side, along, turn in ((1, -0.3, 0.1), (1, 0.32, -0.15), (-1, -0.3, -0.2), (-1, 0.3, 0.1)):
        place = np.array(position) + side * 0.58 * front + along * right
        facing = yaw + turn + (np.pi if side > 0 else 0)
        patches += furniture.chair(tuple(place), facing, cloth, color)
    bowl = textures.rug((0.24, 0.34, 0.52), (0.88, 0.86, 0.80), (0.70, 0.40, 0.22))
    patches += cylinder((*position, 0.74), 0.08, 0.07, bowl, top_radius_m=0.15, texel_m=0.0015)
    for dx, dy, color_ in ((0.05, 0.0, (0.75, 0.22, 0.15)), (-0.05, 0.03, (0.85, 0.55, 0.15))):
        fruit = textures.marbled(color_, (0.9, 0.8, 0.5), 0.03)
        patches.append(sphere((position[0] + dx, position[1] + dy, 0.84), 0.045, fruit))
    return patches


def carpet(
    position: tuple[float, float], size: tuple[float, float], texture: Texture, yaw: float = 0.0
) -> list[Patch]:
    """A rug on the floor."""
    return box((*position, 0.006), (*size, 0.012), texture, yaw=yaw, texel_m=0.003)


def cartons(position: tuple[float, float], yaw: float) -> list[Patch]:
    """Two cartons on each other and one beside them."""
    x, y = position
    patches = furniture.carton((x, y), yaw, (0.52, 0.42, 0.40))
    patches += furniture.carton((x - 0.02, y, 0.401), yaw - 0.4, (0.38, 0.32, 0.28))
    return patches + furniture.carton((x + 0.5, y + 0.1), yaw + 0.5, (0.30, 0.34, 0.30))


def window(room: Chamber, side: str, along: float, width: float = 1.6) -> list[Patch]:
    """A window with a view on a wall, between two curtains."""
    wall, curtain = room.wall(side), textures.fabric((0.66, 0.28, 0.24), (0.82, 0.62, 0.36))
    view = textures.window_view()
    patches = [wall.hung(along - width / 2, 2.2, width, 1.2, view, 0.003, gap=0.012)]
    for end in (along - width / 2, along + width / 2):
        center = wall.point(end, 1.5, 0.07)
        patches += box(center, (0.30, 0.06, 1.7), curtain, yaw=wall.yaw, without=())
    return patches
