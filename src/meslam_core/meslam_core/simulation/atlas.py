"""All textures of a scene in one filtered image, so that a view is one lookup a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.simulation.canvas import Canvas
from meslam_core.simulation.scene import Patch

LEVELS = 4
"""Mip levels; the coarsest has texels eight times as long."""

GUTTER = 2 ** (LEVELS - 1)
"""Border of repeated texels round a patch [px], so that coarse levels do not mix neighbours."""

PAINT_THREADS = 2

LOOKUP_ROW = 1024
"""Columns of the maps that scattered points are looked up with; OpenCV wants small images."""


@dataclass(frozen=True)
class Layout:
    """Where each patch lies in the atlas.

    Attributes:
        corners: (P, 2) column and row of each patch's first texel [px].
        sizes: (P, 2) columns and rows of each patch [px].
        width, height: size of the finest level [px].
    """

    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    width: int
    height: int

    def texels(
        self, index: int, patch: Patch, coordinates_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Atlas positions (N, 2) [px] of texture coordinates (N, 2) [m] on a patch."""
        scale = self.sizes[index] / (patch.width_m, patch.height_m)
        return np.asarray(self.corners[index] + coordinates_m * scale - 0.5)


def lay_out(patches: Sequence[Patch], texel_scale: float = 1.0) -> Layout:
    """Place all patches in rows of falling height.

    Args:
        patches: what to place.
        texel_scale: texels this much longer than the patches ask for, for small cameras.
    """
    sizes = np.array(
        [
            np.ceil(np.array([p.width_m, p.height_m]) / (p.texel_m * texel_scale)).clip(2)
            for p in patches
        ]
    ).astype(np.int64)
    blocks = -(-(sizes + 2 * GUTTER) // GUTTER) * GUTTER
    side = int(np.sqrt(blocks.prod(axis=1).sum()) * 1.05)
    width = -(-max(side, int(blocks[:, 0].max())) // (8 * GUTTER)) * 8 * GUTTER
    corners = np.zeros_like(sizes)
    x = y = row_height = 0
    for index in np.argsort(-blocks[:, 1], kind="stable"):
        if x + blocks[index, 0] > width:
            x, y, row_height = 0, y + row_height, 0
        corners[index] = (x + GUTTER, y + GUTTER)
        x += int(blocks[index, 0])
        row_height = max(row_height, int(blocks[index, 1]))
    return Layout(corners, sizes, width, y + row_height)


class Atlas:
    """The painted and lit textures with their coarser levels.

    Args:
        patches: surfaces in the order of `layout`.
        layout: see `lay_out`.
        irradiance: for each patch (n, m) light on a grid over it, 1 shows the paint as it is.
        seed: of everything random in the textures.

    Attributes:
        image: (H, W, 3) uint8, all levels.
        levels: (3, LEVELS) float32: a level's scale, and its shift in columns and rows [px].
    """

    def __init__(
        self,
        patches: Sequence[Patch],
        layout: Layout,
        irradiance: Sequence[NDArray[np.float32]],
        seed: int,
    ) -> None:
        # The coarser levels lie side by side below the finest.
        self.image = np.zeros((layout.height + layout.height // 2, layout.width, 3), np.uint8)
        with ThreadPoolExecutor(PAINT_THREADS) as pool:
            list(
                pool.map(
                    self._paint,
                    repeat(layout),
                    repeat(seed),
                    range(len(patches)),
                    patches,
                    irradiance,
                )
            )
        corners = np.zeros((LEVELS, 2))
        level, left = self.image[: layout.height], 0
        for index in range(1, LEVELS):
            half = (level.shape[1] // 2, level.shape[0] // 2)
            level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint8)
            self.image[layout.height : layout.height + half[1], left : left + half[0]] = level
            corners[index] = (left, layout.height)
            left += half[0]
        scales = 0.5 ** np.arange(LEVELS)
        shifts = corners.T + 0.5 * scales - 0.5
        self.levels = np.concatenate([scales[None], shifts]).astype(np.float32, order="C")

    def _paint(
        self, layout: Layout, seed: int, index: int, patch: Patch, light: NDArray[np.float32]
    ) -> None:
        """Paint and light one patch in its place of the finest level."""
        columns, rows = (int(n) for n in layout.sizes[index])
        rng = np.random.default_rng((seed, index))
        painted = patch.texture(Canvas(patch.width_m, patch.height_m, rows, columns, rng))
        # Colours are display-referred: light acts before the display's gamma.
        shade = _stretched(light, columns, rows) ** np.float32(1 / 2.2)
        lit = np.clip(painted * (255 * shade[..., None]) + 0.5, 0, 255).astype(np.uint8)
        lit = np.pad(lit, ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0)), mode="edge")
        left, top = layout.corners[index] - GUTTER
        self.image[top : top + lit.shape[0], left : left + lit.shape[1]] = lit

    def lookup(
        self,
        x: NDArray[np.float32],
        y: NDArray[np.float32],
        footprint: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Colours (N, 3) in [0, 255] at atlas positions (N,) [px], filtered over `footprint` [px].

        Trilinear: bilinear in the two levels next to the footprint, then between them.
        """
        coarsest = np.float32(2.0 ** (LEVELS - 1) - 1e-3)
        fineness = np.log2(np.clip(footprint, np.float32(1), coarsest))
        lower = fineness.astype(np.int32)
        share = (fineness - lower)[:, None]
        fine = self._lookup_level(x, y, lower)
        coarse = self._lookup_level(x, y, lower + 1)
        coarse -= fine
        coarse *= share
        coarse += fine
        return coarse

    def _lookup_level(
        self, x: NDArray[np.float32], y: NDArray[np.float32], level: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        # (x + 0.5) * scale - 0.5 + corner, with all constants in one table.
        scale, left, top = self.levels.take(level, axis=1)
        count = len(x)
        rows = -(-count // LOOKUP_ROW)
        maps = np.zeros((2, rows * LOOKUP_ROW), np.float32)
        np.add(x * scale, left, out=maps[0, :count])
        np.add(y * scale, top, out=maps[1, :count])
        map_x, map_y = maps.reshape(2, rows, LOOKUP_ROW)
        colors = cv2.remap(self.image, map_x, map_y, cv2.INTER_LINEAR)
        return colors.reshape(-1, 3)[:count].astype(np.float32)


def _stretched(grid: NDArray[np.float32], columns: int, rows: int) -> NDArray[np.float32]:
    """Bilinear interpolation of a grid whose outer nodes lie on the image's border."""
    x = (np.arange(columns, dtype=np.float32) + 0.5) * ((grid.shape[1] - 1) / columns)
    y = (np.arange(rows, dtype=np.float32) + 0.5) * ((grid.shape[0] - 1) / rows)
    map_x, map_y = np.meshgrid(x, y)
    stretched = cv2.remap(grid, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(stretched, np.float32)
