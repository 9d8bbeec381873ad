"""Rectangular rooms: walls with doorways, floor and ceiling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.simulation.scene import Patch, box, quad
from meslam_core.simulation.textures import Texture

CASING_M = 0.08
"""Width of the frame round a doorway [m]."""


@dataclass(frozen=True)
class Opening:
    """A doorway in a wall.

    Attributes:
        left_m: distance from the wall's left edge, as seen from inside [m].
        width_m, height_m: its size [m].
    """

    left_m: float
    width_m: float = 1.0
    height_m: float = 2.1


@dataclass(frozen=True)
class Wall:
    """The inner face of an upright wall on z = 0.

    Attributes:
        corner: x and y of its left edge as seen from inside [m].
        right: unit vector along it to the right.
        length_m, height_m: its size [m].
    """

    corner: tuple[float, float]
    right: tuple[float, float]
    length_m: float
    height_m: float

    @property
    def yaw(self) -> float:
        """Turn of furniture that stands with its back to the wall [rad]."""
        return float(np.arctan2(self.right[1], self.right[0]))

    def point(self, along: float, z: float, gap: float = 0.0) -> tuple[float, float, float]:
        """The point `along` m right of the left edge and `gap` m before the wall."""
        (x, y), (right_x, right_y) = self.corner, self.right
        inward_x, inward_y = right_y, -right_x
        return (x + along * right_x + gap * inward_x, y + along * right_y + gap * inward_y, z)

    def hung(
        self,
        left: float,
        top: float,
        width: float,
        height: float,
        texture: Texture,
        texel_m: float,
        gap: float = 0.0,
    ) -> Patch:
        """A rectangle `left` m from the left edge, its upper edge `top` m above the floor."""
        right_x, right_y = self.right
        corner = self.point(left, top, gap)
        return quad(
            corner, (width * right_x, width * right_y, 0), (0, 0, -height), texture, texel_m
        )

    def face(self, texture: Texture, texel_m: float, openings: Sequence[Opening] = ()) -> Patch:
        """The whole wall as one patch without the openings."""
        ends = [end for o in openings for end in (o.left_m, o.left_m + o.width_m)]
        cuts = np.unique([0.0, self.length_m, *ends])
        levels = np.unique([0.0, self.height_m, *(self.height_m - o.height_m for o in openings)])
        nodes = np.stack(np.meshgrid(cuts, levels), -1).reshape(-1, 2)
        triangles: list[tuple[int, int, int]] = []
        for row, down in enumerate((levels[:-1] + levels[1:]) / 2):
            for column, along in enumerate((cuts[:-1] + cuts[1:]) / 2):
                if any(
                    0 < along - o.left_m < o.width_m and self.height_m - down < o.height_m
                    for o in openings
                ):
                    continue
                corner = row * len(cuts) + column
                below = corner + len(cuts)
                triangles += [(corner, below, below + 1), (corner, below + 1, corner + 1)]
        return Patch(
            vertices=np.array([self.point(along, self.height_m - down) for along, down in nodes]),
            triangles=np.array(triangles),
            coordinates=nodes,
            width_m=self.length_m,
            height_m=self.height_m,
            texture=texture,
            texel_m=texel_m,
        )

    def doorway(
        self, opening: Opening, thickness_m: float, frame: Texture, sill: Texture, texel_m: float
    ) -> list[Patch]:
        """Reveals, sill and both frames of an opening through a wall of a thickness [m]."""
        left, width, height = opening.left_m, opening.width_m, opening.height_m
        right = np.array([*self.right, 0.0])
        inward = np.array([self.right[1], -self.right[0], 0.0])
        down, through = (0, 0, -height), thickness_m * inward
        patches = [
            quad(self.point(left, height), -through, down, frame, texel_m),
            quad(self.point(left + width, height, -thickness_m), through, down, frame, texel_m),
            quad(self.point(left, height), width * right, -through, frame, texel_m),
            quad(self.point(left, 0, -thickness_m), width * right, through, sill, texel_m),
        ]
        for gap in (0.012, -thickness_m - 0.012):
            size = (CASING_M, 0.024, height + CASING_M)
            for along in (left - CASING_M / 2, left + width + CASING_M / 2):
                center = self.point(along, size[2] / 2, gap)
                patches += box(center, size, frame, yaw=self.yaw, texel_m=texel_m)
            center = self.point(left + width / 2, height + CASING_M / 2, gap)
            lintel = (width, 0.024, CASING_M)
            patches += box(center, lintel, frame, yaw=self.yaw, texel_m=texel_m, without=())
        return patches


@dataclass(frozen=True)
class Chamber:
    """A rectangular room on z = 0.

    Attributes:
        west, south, east, north: its inner faces [m].
        height_m: from floor to ceiling [m].
    """

    west: float
    south: float
    east: float
    north: float
    height_m: float

    def wall(self, side: str) -> Wall:
        """The wall on a side: "south", "north", "west" or "east"."""
        length, width = self.east - self.west, self.north - self.south
        corner, right, extent = {
            "south": ((self.east, self.south), (-1.0, 0.0), length),
            "north": ((self.west, self.north), (1.0, 0.0), length),
            "west": ((self.west, self.south), (0.0, 1.0), width),
            "east": ((self.east, self.north), (0.0, -1.0), width),
        }[side]
        return Wall(corner, right, extent, self.height_m)

    def against(self, side: str, along: float, depth: float) -> tuple[tuple[float, float], float]:
        """Position and yaw of furniture `depth` m deep with its back to a wall."""
        wall = self.wall(side)
        x, y, _ = wall.point(along, 0.0, depth / 2 + 0.03)
        return (x, y), wall.yaw

    def floor_and_ceiling(self, floor: Texture, ceiling: Texture) -> list[Patch]:
        """The two horizontal faces."""
        length, width = self.east - self.west, self.north - self.south
        across: NDArray[np.float64] = np.array([length, 0.0, 0.0])
        low, high = (self.west, self.north, 0.0), (self.west, self.south, self.height_m)
        return [
            quad(low, across, (0, -width, 0), floor, 0.003),
            quad(high, across, (0, width, 0), ceiling, 0.004),
        ]
