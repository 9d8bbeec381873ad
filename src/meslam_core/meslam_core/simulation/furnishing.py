"""What stands and hangs in the rooms of the building, room by room."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from meslam_core.simulation import furniture, textures
from meslam_core.simulation.canvas import Color
from meslam_core.simulation.furniture import BIRCH, OAK, WALNUT
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
    room: Chamber, side: str, along: float, width: float, height: float, seed: int,
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


def _study(room: Chamber) -> list[Patch]:
    patches = couch(room, "south", 1.5, GREEN) + carpet((4.45, 3.8), (1.8, 1.2), RUG, 0.1)
    patches += shelf(room, "north", 1.25, 1.8, 2.0, seed=11)
    patches += workplace(room, "north", 3.4, PLAID, OAK)
    patches += cupboard(room, "west", 1.2, 1.1, 1.9) + window(room, "west", 3.0, 1.4)
    patches += pictures(room, "east", (2.5, 2.1, 0.7, 0.9), (3.5, 2.0, 0.6, 0.6))
    patches += pictures(room, "south", (1.5, 2.2, 1.1, 0.7), (2.8, 2.1, 0.5, 0.7))
    patches += pictures(room, "north", (3.4, 2.3, 0.9, 0.6), (4.7, 2.2, 0.5, 0.8))
    return patches + furniture.plant((5.81, 2.75), 1.2)


def _dining_room(room: Chamber) -> list[Patch]:
    patches = dining((7.98, 3.5), 0.05, RED, WALNUT) + carpet((7.98, 3.5), (2.0, 1.5), BLUE_RUG, 0.05)
    patches += shelf(room, "north", 4.2, 1.8, 1.9, seed=12, color=OAK)
    patches += cupboard(room, "east", 1.25, 1.2, 1.8) + window(room, "north", 2.0)
    patches += pictures(room, "south", (1.2, 2.2, 0.6, 0.9), (2.4, 2.1, 0.9, 0.7))
    patches += pictures(room, "south", (4.0, 2.2, 1.2, 0.8), (5.1, 2.1, 0.5, 0.7))
    patches += pictures(room, "west", (0.8, 2.1, 0.7, 1.0), (2.0, 2.1, 0.8, 0.6))
    patches += cartons((12.08, 2.75), 0.2)
    return patches + furniture.plant((6.95, 6.35, 0.0), 1.3)


def _parlour(room: Chamber) -> list[Patch]:
    patches = couch(room, "north", 1.6, RED) + furniture.floor_lamp((13.62, 6.35), 1.6)
    patches += carpet((14.93, 5.2), (1.7, 1.1), BLUE_RUG, -0.1)
    patches += shelf(room, "west", 3.2, 1.2, 1.9, seed=13) + cupboard(room, "east", 3.4, 1.0, 1.9)
    patches += workplace(room, "south", 1.9, GREEN, BIRCH)
    patches += furniture.plant((15.5, 2.8), 1.25)
    patches += pictures(room, "north", (1.6, 2.2, 1.2, 0.8), (3.2, 2.2, 0.7, 0.9))
    patches += pictures(room, "north", (4.6, 2.1, 0.8, 0.6))
    patches += pictures(room, "south", (1.9, 2.3, 0.9, 0.7), (3.3, 2.2, 0.6, 0.8))
    return patches + pictures(room, "south", (4.5, 2.2, 1.0, 0.7))


def _drawing_room(room: Chamber) -> list[Patch]:
    patches = couch(room, "south", 4.2, PLAID) + carpet((21.43, 3.7), (1.9, 1.3), RUG, -0.05)
    patches += furniture.table((21.43, 3.7), 0.05, (0.9, 0.5, 0.42), WALNUT)
    patches += books((21.32, 3.72), 0.42, 0.3)
    patches += shelf(room, "east", 1.3, 1.8, 2.0, seed=14, color=WALNUT)
    patches += cupboard(room, "east", 3.3, 1.1, 1.85) + window(room, "north", 2.4)
    patches += workplace(room, "north", 4.2, RED, OAK)
    patches += pictures(room, "south", (4.2, 2.2, 1.3, 0.8), (2.8, 2.1, 0.5, 0.7))
    patches += pictures(room, "west", (0.9, 2.2, 0.8, 1.0), (2.0, 2.1, 0.6, 0.6))
    return patches + pictures(room, "north", (4.2, 2.3, 0.9, 0.6), (0.8, 2.1, 0.6, 0.8))


def _store(room: Chamber) -> list[Patch]:
    patches = shelf(room, "south", 4.2, 1.9, 2.0, seed=15) + cartons((4.56, -0.55), 0.1)
    patches += cartons((5.59, -1.5), 1.4) + workplace(room, "south", 2.0, PLAID, BIRCH)
    patches += cupboard(room, "west", 3.4, 1.0, 1.9) + window(room, "west", 1.5, 1.4)
    patches += pictures(room, "north", (3.3, 2.2, 0.7, 0.9), (4.6, 2.2, 0.8, 0.6))
    patches += pictures(room, "south", (2.0, 2.3, 0.8, 0.6), (0.7, 2.1, 0.6, 0.8))
    patches += pictures(room, "east", (1.0, 2.1, 0.9, 0.7), (2.1, 2.1, 0.5, 0.7))
    return patches + carpet((4.1, -2.0), (1.6, 1.1), BLUE_RUG, 0.2)


def _office(room: Chamber) -> list[Patch]:
    patches = workplace(room, "north", 1.4, RED, OAK) + couch(room, "south", 1.8, GREEN)
    patches += shelf(room, "east", 3.3, 1.4, 1.9, seed=16, color=OAK)
    patches += furniture.floor_lamp((9.69, -4.15), 1.6) + furniture.plant((7.01, -2.3), 1.1)
    patches += pictures(room, "north", (1.4, 2.3, 0.9, 0.6), (3.0, 2.2, 0.7, 0.9))
    patches += pictures(room, "north", (4.4, 2.1, 1.0, 0.7))
    patches += pictures(room, "south", (1.8, 2.2, 1.2, 0.8), (3.6, 2.2, 0.6, 0.8))
    patches += pictures(room, "west", (2.3, 2.1, 0.7, 0.9), (3.6, 2.1, 0.8, 0.6))
    return patches + carpet((10.94, -3.3), (1.7, 1.1), RUG, 0.08)


def _canteen(room: Chamber) -> list[Patch]:
    patches = dining((17.9, -1.35), -0.08, GREEN, BIRCH)
    patches += carpet((17.9, -1.35), (2.0, 1.5), RUG, -0.08)
    patches += shelf(room, "south", 4.3, 1.8, 1.9, seed=17, color=WALNUT)
    patches += cupboard(room, "west", 1.2, 1.1, 1.8) + window(room, "south", 1.9)
    patches += pictures(room, "north", (1.0, 2.2, 0.7, 0.9), (2.4, 2.1, 0.9, 0.7))
    patches += pictures(room, "north", (4.2, 2.2, 1.3, 0.8))
    patches += pictures(room, "east", (0.9, 2.2, 0.8, 1.0), (2.0, 2.1, 0.6, 0.7))
    return patches + furniture.plant((13.68, -0.6), 1.2)


def _reading_room(room: Chamber) -> list[Patch]:
    patches = couch(room, "north", 1.4, PLAID) + carpet((21.32, -1.6), (1.8, 1.2), BLUE_RUG, 0.06)
    patches += cupboard(room, "east", 1.1, 1.1, 1.9) + shelf(room, "east", 3.1, 1.8, 2.0, seed=18)
    patches += workplace(room, "south", 1.9, RED, WALNUT) + window(room, "south", 4.1, 1.5)
    patches += pictures(room, "north", (1.4, 2.2, 1.2, 0.8), (2.7, 2.1, 0.5, 0.7))
    patches += pictures(room, "north", (5.0, 2.1, 0.6, 0.9))
    patches += pictures(room, "south", (1.9, 2.3, 0.9, 0.6))
    patches += pictures(room, "west", (2.0, 2.1, 0.8, 1.0), (3.3, 2.1, 0.7, 0.6))
    return patches + furniture.plant((20.12, -2.3), 1.15)


ROOMS: tuple[Callable[[Chamber], list[Patch]], ...] = (
    _study,
    _dining_room,
    _parlour,
    _drawing_room,
    _store,
    _office,
    _canteen,
    _reading_room,
)


def corridor(room: Chamber) -> list[Patch]:
    """Low shelves, notices, plants and cartons; they leave a way of a metre and a half."""
    patches: list[Patch] = []
    for number, (side, along) in enumerate(
        (("south", 17.0), ("north", 9.5), ("south", 9.3), ("north", 17.2), ("south", 4.4))
    ):
        patches += shelf(room, side, along, 1.6, 1.15, seed=30 + number, color=(OAK, BIRCH)[number % 2])
    rng = np.random.default_rng(7)
    for side in ("south", "north"):
        for along in np.arange(3.2, 19.6, 1.35):
            width, height = rng.uniform(0.5, 0.9), rng.uniform(0.5, 0.8)
            patches += pictures(room, side, (float(along), 2.15, float(width), float(height)))
    patches += pictures(room, "west", (1.1, 2.1, 1.2, 0.9)) + pictures(room, "east", (1.1, 2.1, 1.2, 0.9))
    for position in ((0.51, 0.45), (14.2, 1.85), (25.6, 0.4)):
        patches += furniture.plant(position, 1.2)
    return patches + cartons((24.97, 1.8), 0.1) + cartons((4.1, 0.35), 0.0)
