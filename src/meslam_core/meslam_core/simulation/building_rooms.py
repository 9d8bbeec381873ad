"""What stands and hangs in the rooms of the building, room by room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from meslam_core.simulation import furniture
from meslam_core.simulation.furnishing import (
    BLUE_RUG,
    GREEN,
    PLAID,
    RED,
    RUG,
    books,
    carpet,
    cartons,
    couch,
    cupboard,
    dining,
    pictures,
    shelf,
    window,
    workplace,
)
from meslam_core.simulation.furniture import BIRCH, OAK, WALNUT
from meslam_core.simulation.scene import Patch
from meslam_core.simulation.walls import Chamber


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
    patches = dining((7.98, 3.5), 0.05, RED, WALNUT) + carpet(
        (7.98, 3.5), (2.0, 1.5), BLUE_RUG, 0.05
    )
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
        patches += shelf(
            room, side, along, 1.6, 1.15, seed=30 + number, color=(OAK, BIRCH)[number % 2]
        )
    rng = np.random.default_rng(7)
    for side in ("south", "north"):
        for along in np.arange(3.2, 19.6, 1.35):
            width, height = rng.uniform(0.5, 0.9), rng.uniform(0.5, 0.8)
            patches += pictures(room, side, (float(along), 2.15, float(width), float(height)))
    patches += pictures(room, "west", (1.1, 2.1, 1.2, 0.9)) + pictures(
        room, "east", (1.1, 2.1, 1.2, 0.9)
    )
    for position in ((0.51, 0.45), (14.2, 1.85), (25.6, 0.4)):
        patches += furniture.plant(position, 1.2)
    return patches + cartons((24.97, 1.8), 0.1) + cartons((4.1, 0.35), 0.0)
