"""The scene `room`: a furnished living room of 5 m by 4 m, 2.6 m high."""

from __future__ import annotations

import numpy as np

from meslam_core.simulation import furniture, textures
from meslam_core.simulation.path import Route
from meslam_core.simulation.scene import Lamp, Patch, Scene, box, cylinder, sphere
from meslam_core.simulation.walls import Chamber

LENGTH_M, WIDTH_M, HEIGHT_M = 5.0, 4.0, 2.6

CHAMBER = Chamber(0.0, 0.0, LENGTH_M, WIDTH_M, HEIGHT_M)


def room() -> Scene:
    """Build the room: origin in a lower corner, x along its length, z up."""
    patches = [*_shell(), *_wall_decoration(), *_floor_things(), *_furniture()]
    lamps = [Lamp((1.5, 2.1, 2.5), 0.5, 6.0), Lamp((3.6, 1.8, 2.5), 0.5, 6.0)]
    return Scene("room", patches, lamps, ambient=0.45, route=_route())


def _route() -> Route:
    """A figure of eight through the middle, while the camera turns once about itself."""
    phase = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    anchors = np.stack(
        [
            2.5 + 0.95 * np.sin(phase),
            2.0 + 0.50 * np.sin(2 * phase),
            1.30 + 0.14 * np.sin(phase + 0.8) + 0.06 * np.sin(3 * phase),
            0.4 + phase + 0.16 * np.sin(2 * phase + 0.5),
            np.radians(13 + 11 * np.sin(2 * phase + 1.0)),
        ],
        axis=1,
    )
    return Route(anchors)


def _shell() -> list[Patch]:
    """Walls, floor, ceiling and skirting."""
    papers = {
        "south": textures.wallpaper((0.80, 0.78, 0.66), (0.44, 0.50, 0.38)),
        "north": textures.plaster((0.62, 0.72, 0.78), roughness=0.04),
        "west": textures.bricks((0.62, 0.36, 0.28)),
        "east": textures.plaster((0.86, 0.80, 0.68), roughness=0.04),
    }
    patches = [
        (face := CHAMBER.wall(side)).hung(0.0, HEIGHT_M, face.length_m, HEIGHT_M, paper, 0.003)
        for side, paper in papers.items()
    ]
    ceiling = textures.checker((0.86, 0.86, 0.84), (0.80, 0.80, 0.79), 0.6)
    patches += CHAMBER.floor_and_ceiling(textures.planks((0.60, 0.44, 0.30)), ceiling)
    wood = textures.wood((0.88, 0.86, 0.82), contrast=0.08)
    for wall in papers:
        length = CHAMBER.wall(wall).length_m
        if wall in ("south", "north"):
            y = 0.009 if wall == "south" else WIDTH_M - 0.009
            patches += box((length / 2, y, 0.045), (length - 0.05, 0.016, 0.09), wood)
        else:
            x = 0.009 if wall == "west" else LENGTH_M - 0.009
            patches += box((x, length / 2, 0.045), (0.016, length - 0.05, 0.09), wood)
    return patches


def _wall_decoration() -> list[Patch]:
    """Window, curtains, posters, a door and a radiator."""
    poster = textures.poster()
    patches = [
        CHAMBER.wall("north").hung(0.50, 2.05, 0.60, 0.85, poster, 0.002, gap=0.012),
        CHAMBER.wall("north").hung(2.30, 2.25, 0.90, 0.60, poster, 0.002, gap=0.012),
        CHAMBER.wall("north").hung(3.50, 2.10, 0.45, 0.62, poster, 0.002, gap=0.012),
        CHAMBER.wall("north").hung(4.20, 2.00, 0.50, 0.70, poster, 0.002, gap=0.012),
        CHAMBER.wall("east").hung(0.35, 2.10, 0.70, 1.00, poster, 0.002, gap=0.012),
        CHAMBER.wall("west").hung(0.25, 2.05, 0.55, 0.78, poster, 0.002, gap=0.012),
        CHAMBER.wall("west").hung(3.20, 2.10, 0.60, 0.80, poster, 0.002, gap=0.012),
        CHAMBER.wall("south").hung(0.45, 2.10, 0.60, 0.42, poster, 0.002, gap=0.012),
        CHAMBER.wall("south").hung(0.50, 1.55, 0.42, 0.60, poster, 0.002, gap=0.012),
        CHAMBER.wall("south").hung(
            1.70, 2.15, 1.60, 1.15, textures.window_view(), 0.003, gap=0.012
        ),
    ]
    curtain = textures.fabric((0.66, 0.28, 0.24), (0.82, 0.62, 0.36))
    for x in (1.45, 3.55):
        patches += box((x, 0.07, 1.45), (0.32, 0.06, 1.70), curtain, without=())
    patches += box((2.5, 0.06, 2.33), (2.7, 0.04, 0.05), textures.wood(furniture.WALNUT))
    door = textures.wood((0.78, 0.66, 0.48), contrast=0.2)
    patches += box((4.985, 1.45, 1.02), (0.02, 0.90, 2.04), door, without=("right", "bottom"))
    knob = textures.marbled((0.75, 0.70, 0.45), (0.55, 0.50, 0.35))
    patches.append(sphere((4.94, 1.10, 1.02), 0.03, knob))
    return patches


def _floor_things() -> list[Patch]:
    """A rug, cartons, a ball and a paper basket."""
    red_rug = textures.rug((0.55, 0.20, 0.18), (0.80, 0.70, 0.52), (0.18, 0.24, 0.38))
    patches = box((2.5, 1.95, 0.006), (2.2, 1.5, 0.012), red_rug, yaw=0.06, texel_m=0.003)
    patches += furniture.carton((4.62, 0.42), 0.15, (0.52, 0.42, 0.40))
    patches += furniture.carton((4.60, 0.42, 0.401), -0.25, (0.38, 0.32, 0.28))
    patches += furniture.carton((4.05, 0.34), 0.5, (0.30, 0.34, 0.30))
    ball = textures.checker((0.85, 0.35, 0.20), (0.92, 0.90, 0.84), 0.09)
    patches.append(sphere((1.15, 3.45, 0.13), 0.13, ball))
    basket = textures.fabric((0.48, 0.42, 0.36), (0.30, 0.26, 0.22))
    patches += cylinder((3.78, 3.72, 0), 0.13, 0.32, basket, top_radius_m=0.16)
    return patches


def _furniture() -> list[Patch]:
    """A desk, a low table, a sofa, a shelf, a cupboard, and what stands on them."""
    quarter = np.pi / 2
    plaid = textures.fabric((0.30, 0.38, 0.52), (0.78, 0.74, 0.62))
    patches = furniture.table((2.75, 3.60), 0.0, (1.5, 0.7, 0.74), furniture.OAK)
    patches += furniture.chair((2.55, 3.05), 0.25 + np.pi, plaid)
    patches += furniture.monitor((2.75, 3.72, 0.74), 0.1)
    patches += _desk_things()
    patches += furniture.table((2.45, 1.85), 0.06, (0.95, 0.55, 0.42), furniture.WALNUT)
    patches += _low_table_things()
    cloth = textures.fabric((0.36, 0.46, 0.40), (0.46, 0.56, 0.48))
    pillow = textures.rug((0.80, 0.62, 0.28), (0.32, 0.22, 0.20), (0.86, 0.82, 0.72))
    patches += furniture.sofa((2.45, 0.52), np.pi, 2.0, cloth, pillow)
    patches += furniture.bookshelf((0.18, 2.05), quarter, (1.7, 0.30, 1.90), seed=5)
    patches += furniture.wardrobe((4.68, 3.02), -quarter, (1.0, 0.55, 1.85))
    patches += furniture.chair((4.45, 2.05), -quarter - 0.3, cloth, furniture.BIRCH)
    patches += furniture.plant((0.42, 0.42), 1.15)
    patches += furniture.floor_lamp((0.45, 3.60), 1.55)
    patches += furniture.carton((4.65, 3.10, 1.851), 1.4, (0.45, 0.36, 0.26))
    return patches


def _desk_things() -> list[Patch]:
    """Books, a mug and a globe."""
    spine, paper = textures.book_spine(), textures.poster()
    patches: list[Patch] = []
    for index, (width, depth, yaw) in enumerate(
        ((0.28, 0.20, 0.2), (0.25, 0.19, -0.1), (0.22, 0.16, 0.5))
    ):
        center = (2.22, 3.55, 0.742 + 0.02 + 0.041 * index)
        patches += box(center, (width, depth, 0.04), {"side": spine, "top": paper}, yaw=yaw)
    mug = textures.checker((0.20, 0.45, 0.60), (0.90, 0.88, 0.80), 0.03)
    patches += cylinder((3.20, 3.42, 0.74), 0.042, 0.10, mug, texel_m=0.0015)
    globe = textures.marbled((0.18, 0.38, 0.62), (0.55, 0.62, 0.30), 0.10)
    patches += cylinder((3.32, 3.70, 0.74), 0.08, 0.02, textures.wood(furniture.WALNUT))
    patches.append(sphere((3.32, 3.70, 0.90), 0.14, globe))
    return patches


def _low_table_things() -> list[Patch]:
    """A vase, a tray of fruit and a magazine."""
    vase = textures.rug((0.24, 0.34, 0.52), (0.88, 0.86, 0.80), (0.70, 0.40, 0.22))
    patches = cylinder((2.72, 1.95, 0.42), 0.05, 0.22, vase, top_radius_m=0.075, texel_m=0.0015)
    magazine = {"side": textures.fabric((0.9, 0.9, 0.88)), "top": textures.poster()}
    patches += box((2.20, 1.78, 0.427), (0.30, 0.22, 0.012), magazine, yaw=0.4)
    for x, y, color in (
        (2.46, 1.98, (0.75, 0.22, 0.15)),
        (2.54, 1.93, (0.85, 0.55, 0.15)),
        (2.47, 1.89, (0.55, 0.62, 0.20)),
    ):
        patches.append(sphere((x, y, 0.46), 0.04, textures.marbled(color, (0.9, 0.8, 0.5), 0.03)))
    return patches
