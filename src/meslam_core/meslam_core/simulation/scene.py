"""Scenes: textured patches of surface, the lamps that light them, a way for a hand-held camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from meslam_core.simulation.path import Route
from meslam_core.simulation.textures import Texture

Vector = Sequence[float] | NDArray[np.floating]

FACES = ("left", "right", "front", "back", "bottom", "top")
"""Faces of a box: -x, +x, -y, +y, -z, +z in its own frame."""


@dataclass(frozen=True)
class Patch:
    """A piece of surface that unrolls onto one rectangle of texture.

    Attributes:
        vertices: (N, 3) float64 in the scene's frame, z up [m].
        triangles: (M, 3) int64, counter-clockwise seen from outside.
        coordinates: (N, 2) float64, position on the rectangle: along columns, along rows [m].
        width_m, height_m: size of the rectangle [m].
        texture: what is painted on it.
        texel_m: length of a texel [m].
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    coordinates: NDArray[np.float64]
    width_m: float
    height_m: float
    texture: Texture
    texel_m: float


@dataclass(frozen=True)
class Lamp:
    """A horizontal square that lights what is below it.

    Attributes:
        center: middle of the square [m].
        side_m: its side [m].
        power: irradiance straight below it at 1 m, in units of a mid exposure.
        reach_m: how far its light is followed [m].
    """

    center: tuple[float, float, float]
    side_m: float
    power: float
    reach_m: float = np.inf


@dataclass
class Scene:
    """A space to record.

    Attributes:
        name: its name in the registry.
        patches: all surfaces.
        lamps: all lights.
        ambient: light that reaches every open surface, in units of a mid exposure.
        route: the way of the camera.
    """

    name: str
    patches: list[Patch] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    ambient: float = 0.35
    route: Route = field(default_factory=lambda: Route(np.zeros((1, 5))))


def quad(
    corner: Vector, along_columns: Vector, along_rows: Vector, texture: Texture, texel_m: float
) -> Patch:
    """A rectangle from its top-left corner as seen from outside, spanned by two edges [m]."""
    corner, right, down = (np.asarray(v, float) for v in (corner, along_columns, along_rows))
    width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    return Patch(
        vertices=np.stack([corner, corner + down, corner + right + down, corner + right]),
        triangles=np.array([[0, 1, 2], [0, 2, 3]]),
        coordinates=np.array([[0, 0], [0, height], [width, height], [width, 0]]),
        width_m=width,
        height_m=height,
        texture=texture,
        texel_m=texel_m,
    )


def box(
    center: Vector,
    size: Vector,
    textures: Texture | dict[str, Texture],
    *,
    yaw: float = 0.0,
    texel_m: float = 0.0025,
    without: Sequence[str] = ("bottom",),
) -> list[Patch]:
    """A box turned about the vertical, its faces unrolled one by one.

    Args:
        center, size: in the scene's frame before turning [m].
        textures: one for all faces, or by name of FACES with "side" for those not named.
        yaw: turn about the vertical through the centre [rad].
        texel_m: length of a texel [m].
        without: faces to leave out because nothing can see them.
    """
    half = np.asarray(size, float) / 2
    x, y, z = 2 * half
    spans = {
        "left": ((-1, 1, 1), (0, -y, 0), (0, 0, -z)),
        "right": ((1, -1, 1), (0, y, 0), (0, 0, -z)),
        "front": ((-1, -1, 1), (x, 0, 0), (0, 0, -z)),
        "back": ((1, 1, 1), (-x, 0, 0), (0, 0, -z)),
        "bottom": ((-1, -1, -1), (x, 0, 0), (0, y, 0)),
        "top": ((-1, 1, 1), (x, 0, 0), (0, -y, 0)),
    }
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    patches = []
    for face in FACES:
        if face in without:
            continue
        texture = textures if callable(textures) else textures.get(face, textures.get("side"))
        if texture is None:
            raise KeyError(f"box has no texture for its face {face!r}")
        sign, right, down = (np.array(v, float) for v in spans[face])
        corner = np.asarray(center, float) + turn @ (sign * half)
        patches.append(quad(corner, turn @ right, turn @ down, texture, texel_m))
    return patches


def cylinder(
    base: Vector,
    radius_m: float,
    height_m: float,
    texture: Texture,
    *,
    top_radius_m: float | None = None,
    texel_m: float = 0.0025,
    segments: int = 32,
) -> list[Patch]:
    """An upright cylinder or cone frustum on `base`, with a lid and no bottom."""
    top_radius = radius_m if top_radius_m is None else top_radius_m
    angles = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], 1)
    upper = np.asarray(base, float) + top_radius * ring + (0, 0, height_m)
    lower = np.asarray(base, float) + radius_m * ring
    width = 2 * np.pi * max(radius_m, top_radius)
    columns = width * angles / (2 * np.pi)
    first = np.arange(segments)
    below = first + segments + 1
    side = Patch(
        vertices=np.concatenate([upper, lower]),
        triangles=np.concatenate(
            [np.stack([first, below, below + 1], 1), np.stack([first, below + 1, first + 1], 1)]
        ),
        coordinates=np.concatenate(
            [
                np.stack([columns, np.zeros_like(columns)], 1),
                np.stack([columns, np.full_like(columns, height_m)], 1),
            ]
        ),
        width_m=width,
        height_m=height_m,
        texture=texture,
        texel_m=texel_m,
    )
    middle = np.add(base, (0, 0, height_m))
    lid = Patch(
        vertices=np.concatenate([middle[None], upper[:-1]]),
        triangles=np.stack([np.zeros_like(first), first + 1, (first + 1) % segments + 1], 1),
        coordinates=top_radius * (np.concatenate([np.zeros((1, 2)), ring[:-1, :2] * (1, -1)]) + 1),
        width_m=2 * top_radius,
        height_m=2 * top_radius,
        texture=texture,
        texel_m=texel_m,
    )
    return [side, lid]


def sphere(
    center: Vector,
    radius_m: float,
    texture: Texture,
    *,
    texel_m: float = 0.0025,
    segments: int = 40,
) -> Patch:
    """A sphere unrolled by longitude and latitude."""
    longitudes = np.linspace(0, 2 * np.pi, segments + 1)
    latitudes = np.linspace(0, np.pi, segments // 2 + 1)
    lat, lon = np.meshgrid(latitudes, longitudes, indexing="ij")
    normals = np.stack([np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)], -1)
    rows, columns = np.meshgrid(np.arange(segments // 2), np.arange(segments), indexing="ij")
    corner = (rows * (segments + 1) + columns).ravel()
    below = corner + segments + 1
    return Patch(
        vertices=np.asarray(center, float) + radius_m * normals.reshape(-1, 3),
        triangles=np.concatenate(
            [np.stack([corner, below, below + 1], 1), np.stack([corner, below + 1, corner + 1], 1)]
        ),
        coordinates=radius_m * np.stack([lon, lat], -1).reshape(-1, 2),
        width_m=2 * np.pi * radius_m,
        height_m=np.pi * radius_m,
        texture=texture,
        texel_m=texel_m,
    )
