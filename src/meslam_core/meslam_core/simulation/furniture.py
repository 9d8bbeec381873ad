"""Furniture for scenes, built of boxes, cylinders and spheres; it stands on z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from meslam_core.simulation import textures
from meslam_core.simulation.canvas import Color
from meslam_core.simulation.scene import Patch, Vector, box, cylinder, sphere
from meslam_core.simulation.textures import Texture

OAK = (0.66, 0.48, 0.30)
WALNUT = (0.42, 0.28, 0.18)
BIRCH = (0.82, 0.70, 0.52)


@dataclass(frozen=True)
class Block:
    """A box of a piece of furniture in the piece's own frame: x width, y depth, -y is its front."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    textures: Texture | dict[str, Texture]
    without: tuple[str, ...] = ()


def placed(blocks: Sequence[Block], position: Vector, yaw: float) -> list[Patch]:
    """Blocks turned by `yaw` [rad] and moved to `position` (x, y or x, y, z) [m]."""
    patches = []
    shift = np.zeros(3)
    shift[: len(position)] = position
    cosine, sine = np.cos(yaw), np.sin(yaw)
    for block in blocks:
        x, y, z = block.center
        center = np.add(shift, (cosine * x - sine * y, sine * x + cosine * y, z))
        patches += box(center, block.size, block.textures, yaw=yaw, without=block.without)
    return patches


def _legs(width: float, depth: float, height: float, side: float, texture: Texture) -> list[Block]:
    """Four legs under the corners of a plate; they end a little inside it."""
    x, y = (width - side) / 2 - 0.02, (depth - side) / 2 - 0.02
    size = (side, side, height)
    return [
        Block((sx * x, sy * y, height / 2), size, texture, ("bottom", "top"))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]


def table(
    position: Vector, yaw: float, size: tuple[float, float, float], color: Color
) -> list[Patch]:
    """A table of (width, depth, height) [m]."""
    width, depth, height = size
    wood = textures.wood(color)
    plate = Block((0, 0, height - 0.02), (width, depth, 0.04), wood)
    return placed([plate, *_legs(width, depth, height - 0.04, 0.06, wood)], position, yaw)


def chair(position: Vector, yaw: float, cushion: Texture, color: Color = OAK) -> list[Patch]:
    """A chair whose sitter looks along its -y."""
    wood = textures.wood(color)
    seat = Block((0, 0, 0.445), (0.42, 0.42, 0.05), {"side": wood, "top": cushion})
    back = Block((0, 0.19, 0.79), (0.40, 0.03, 0.34), wood)
    posts = [Block((x, 0.19, 0.57), (0.035, 0.028, 0.24), wood, ("top",)) for x in (-0.17, 0.17)]
    return placed([seat, back, *posts, *_legs(0.42, 0.42, 0.42, 0.04, wood)], position, yaw)


def bookshelf(
    position: Vector,
    yaw: float,
    size: tuple[float, float, float],
    seed: int,
    color: Color = BIRCH,
    boards: int = 5,
) -> list[Patch]:
    """A shelf of (width, depth, height) [m] full of books, with gaps."""
    width, depth, height = size
    rng = np.random.default_rng(seed)
    wood = textures.wood(color)
    thickness = 0.025
    blocks = [
        Block((side * (width - thickness) / 2, 0, height / 2), (thickness, depth, height), wood)
        for side in (-1, 1)
    ]
    inner = width - 2 * thickness
    blocks.append(
        Block((0, depth / 2 - 0.01, height / 2), (inner, 0.01, height - 0.02), wood, ("back",))
    )
    levels = np.linspace(0.06, height - thickness / 2 - 0.01, boards + 1)
    for level in levels:
        blocks.append(Block((0, -0.005, level), (inner, depth - 0.02, thickness), wood))
    for level, above in pairwise(levels):
        blocks += _books(rng, inner, depth, level + thickness / 2, above - level - thickness)
    return placed(blocks, position, yaw)


def _books(
    rng: np.random.Generator, width: float, depth: float, floor: float, room: float
) -> list[Block]:
    """Books standing in a compartment."""
    blocks = []
    spine, paper = textures.book_spine(), textures.fabric((0.88, 0.85, 0.78))
    x = -width / 2 + 0.01
    while x < width / 2 - 0.08:
        if rng.random() < 0.12:
            x += rng.uniform(0.06, 0.20)
            continue
        thickness = rng.uniform(0.025, 0.065)
        height = rng.uniform(0.60, 0.92) * room
        deep = rng.uniform(0.55, 0.80) * depth
        front = -depth / 2 + rng.uniform(0.015, 0.05)
        blocks.append(
            Block(
                (x + thickness / 2, front + deep / 2, floor + height / 2),
                (thickness, deep, height),
                {"side": spine, "top": paper},
                ("bottom", "back"),
            )
        )
        x += thickness + 0.002
    return blocks


def sofa(
    position: Vector, yaw: float, width: float, cloth: Texture, pillow: Texture
) -> list[Patch]:
    """A sofa with its back at +y."""
    inner = width - 0.36
    blocks = [
        Block((0, 0.0, 0.22), (inner, 0.80, 0.36), cloth, ("left", "right", "bottom")),
        Block((0, 0.31, 0.60), (inner, 0.18, 0.42), cloth, ("left", "right")),
    ]
    blocks += [
        Block((side * (width / 2 - 0.09), 0.0, 0.32), (0.18, 0.82, 0.62), cloth, ("bottom",))
        for side in (-1, 1)
    ]
    blocks += [
        Block((x * inner / 2, -0.08, 0.46), (0.96 * inner / 2, 0.60, 0.12), cloth, ("bottom",))
        for x in (-0.5, 0.5)
    ]
    blocks += [Block((x * inner, 0.14, 0.69), (0.42, 0.12, 0.36), pillow) for x in (-0.30, 0.27)]
    return placed(blocks, position, yaw)


def wardrobe(position: Vector, yaw: float, size: tuple[float, float, float]) -> list[Patch]:
    """A cupboard of (width, depth, height) [m] with two doors and handles."""
    width, depth, height = size
    wood = textures.wood(WALNUT)
    door = textures.wood((0.50, 0.34, 0.22), contrast=0.22)
    blocks = [Block((0, 0, height / 2), (width, depth, height), wood, ("bottom", "back"))]
    for side in (-1, 1):
        center = (side * width / 4, -depth / 2 - 0.012, height / 2 + 0.03)
        blocks.append(Block(center, (width / 2 - 0.03, 0.02, height - 0.14), door, ("back",)))
        handle = (side * 0.05, -depth / 2 - 0.035, height / 2)
        blocks.append(Block(handle, (0.02, 0.025, 0.16), textures.marbled((0.7, 0.7, 0.72), OAK)))
    return placed(blocks, position, yaw)


def monitor(position: Vector, yaw: float) -> list[Patch]:
    """A screen on a foot, showing a picture to its -y."""
    black = textures.marbled((0.14, 0.14, 0.15), (0.22, 0.22, 0.23))
    blocks = [
        Block((0, 0, 0.01), (0.24, 0.18, 0.02), black, ("bottom",)),
        Block((0, 0.03, 0.09), (0.05, 0.03, 0.15), black, ("bottom", "top")),
        Block((0, 0, 0.30), (0.54, 0.04, 0.33), {"side": black, "front": textures.poster()}),
    ]
    return placed(blocks, position, yaw)


def carton(position: Vector, yaw: float, size: tuple[float, float, float]) -> list[Patch]:
    """A cardboard box of (width, depth, height) [m]."""
    block = Block((0, 0, size[2] / 2), size, textures.cardboard(), ("bottom",))
    return placed([block], position, yaw)


def plant(position: Vector, height: float) -> list[Patch]:
    """A pot with a stem and a few round crowns of leaves."""
    x, y, *rest = (float(v) for v in position)
    z = rest[0] if rest else 0.0
    leaves = textures.marbled((0.20, 0.42, 0.16), (0.42, 0.60, 0.25), 0.05)
    pot = textures.rug((0.72, 0.40, 0.28), (0.85, 0.75, 0.60), (0.45, 0.25, 0.20))
    patches = cylinder((x, y, z), 0.11, 0.26, pot, top_radius_m=0.15)
    patches += cylinder((x, y, z + 0.26), 0.015, height - 0.26, textures.wood(WALNUT), segments=12)
    for dx, dy, dz, radius in (
        (0, 0, 0, 0.20),
        (0.14, 0.05, -0.16, 0.13),
        (-0.1, -0.1, -0.2, 0.14),
    ):
        patches.append(sphere((x + dx, y + dy, z + height + dz), radius, leaves))
    return patches


def floor_lamp(position: Vector, height: float) -> list[Patch]:
    """A stand with a conical shade."""
    x, y = float(position[0]), float(position[1])
    metal = textures.marbled((0.30, 0.30, 0.32), (0.45, 0.45, 0.46))
    shade = textures.fabric((0.92, 0.84, 0.66), (0.70, 0.45, 0.30))
    patches = cylinder((x, y, 0), 0.14, 0.03, metal)
    patches += cylinder((x, y, 0.03), 0.018, height - 0.33, metal, segments=12)
    return patches + cylinder((x, y, height - 0.32), 0.22, 0.32, shade, top_radius_m=0.13)
