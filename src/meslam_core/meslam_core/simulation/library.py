"""The scene `library`: a room of 57 m³ full of books, seen whole in half a minute."""

from __future__ import annotations

import numpy as np

from meslam_core.simulation import furnishing, furniture, textures
from meslam_core.simulation.furniture import BIRCH, OAK, WALNUT
from meslam_core.simulation.path import Route
from meslam_core.simulation.scene import Lamp, Patch, Scene, box, cylinder, sphere
from meslam_core.simulation.walls import Chamber

CHAMBER = Chamber(0.0, 0.0, 5.6, 3.9, 2.6)
ROUND_S = 29.0
"""Time of one round, with the time to get going half a minute [s]."""


def library() -> Scene:
    """Build it: origin in a lower corner, x along its length, z up."""
    patches = [*_shell(), *_shelves(), *_corners()]
    lamps = [Lamp((1.6, 1.95, 2.5), 0.5, 6.0), Lamp((4.0, 1.95, 2.5), 0.5, 6.0)]
    return Scene("library", patches, lamps, ambient=0.5, route=_route())


def _route() -> Route:
    """A figure of eight from west to east and back, with two turns: looking down, looking up.

    Its 2.2 m from west to east are more than one region of 30 m³ and less than three.
    """
    phase = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    anchors = np.stack(
        [
            2.75 - 1.10 * np.cos(phase),
            1.95 + 0.60 * np.sin(2 * phase),
            1.38 + 0.12 * np.sin(phase + 0.8),
            -2 * phase + 0.12 * np.sin(3 * phase),
            np.radians(7 + 24.5 * np.tanh(2 * np.sin(phase - 0.147))),
        ],
        axis=1,
    )
    once = Route(anchors)
    return Route(anchors, once.round_m / ROUND_S, spread=(0.025, 0.025, 0.04, 0.025, 0.02))


def _shell() -> list[Patch]:
    """Walls, floor, ceiling, a door and a window."""
    papers = {
        "south": textures.wallpaper((0.78, 0.74, 0.62), (0.46, 0.36, 0.30), 0.26),
        "north": textures.plaster((0.70, 0.66, 0.56), roughness=0.05),
        "west": textures.wallpaper((0.66, 0.72, 0.66), (0.30, 0.42, 0.36)),
        "east": textures.plaster((0.80, 0.72, 0.62), roughness=0.05),
    }
    patches = [CHAMBER.wall(side).face(paper, 0.003) for side, paper in papers.items()]
    ceiling = textures.checker((0.86, 0.85, 0.82), (0.76, 0.75, 0.73), 0.5)
    patches += CHAMBER.floor_and_ceiling(textures.planks((0.52, 0.38, 0.26), 0.11, 1.0), ceiling)
    door = textures.wood((0.70, 0.56, 0.40), contrast=0.2)
    patches += box((1.05, 0.015, 1.02), (0.90, 0.03, 2.04), door)
    knob = textures.marbled((0.75, 0.70, 0.45), (0.55, 0.50, 0.35))
    patches.append(sphere((1.40, 0.06, 1.02), 0.03, knob))
    patches += furnishing.window(CHAMBER, "north", 2.8, 1.1)
    return patches


def _shelves() -> list[Patch]:
    """Bookshelves along all walls, with prints above them."""
    patches: list[Patch] = []
    for number, (side, along, width, height) in enumerate(
        (
            ("west", 0.95, 1.7, 2.1),
            ("west", 2.75, 1.8, 2.1),
            ("east", 1.10, 1.8, 2.1),
            ("east", 2.95, 1.7, 1.9),
            ("north", 1.20, 1.7, 1.9),
            ("north", 4.30, 1.8, 2.1),
            ("south", 1.30, 1.8, 2.0),
        )
    ):
        color = (BIRCH, OAK, WALNUT)[number % 3]
        patches += furnishing.shelf(CHAMBER, side, along, width, height, 40 + number, color)
    patches += furnishing.shelf(CHAMBER, "north", 2.75, 1.1, 0.85, 49, OAK)
    patches += furnishing.pictures(CHAMBER, "south", (2.75, 2.2, 0.8, 0.9), (3.55, 2.1, 0.5, 0.7))
    return patches + furnishing.pictures(CHAMBER, "south", (5.2, 2.2, 0.5, 0.8))


def _corners() -> list[Patch]:
    """A rug, a sofa, a globe, a carton with books, a lamp."""
    patches = furnishing.carpet((2.75, 1.95), (2.4, 1.7), furnishing.RUG, 0.03)
    patches += furniture.sofa((2.75, 0.48), np.pi, 1.2, furnishing.RED, furnishing.PILLOW)
    patches += furniture.floor_lamp((0.45, 0.35), 1.6)
    globe = textures.marbled((0.18, 0.38, 0.62), (0.55, 0.62, 0.30), 0.10)
    patches += cylinder((5.25, 0.40, 0), 0.13, 0.62, textures.wood(WALNUT), top_radius_m=0.09)
    patches.append(sphere((5.25, 0.40, 0.84), 0.22, globe))
    patches += furniture.carton((1.80, 3.45), 0.3, (0.40, 0.32, 0.32))
    return patches + furnishing.books((1.80, 3.45), 0.321, 0.2)
