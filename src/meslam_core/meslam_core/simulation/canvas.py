"""The flat image that a texture is painted on, and the strokes to paint it with."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
"""(rows, columns, 3) display-referred RGB in [0, 1]."""

Plane = NDArray[np.floating]
"""(rows, columns), or what broadcasts to it: one number a pixel."""

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Canvas:
    """The patch to paint.

    Attributes:
        width_m, height_m: size of the patch along its columns and rows [m].
        rows, columns: size of the image [px].
        rng: source of everything random; drawn from in units of metres, not of pixels, so that
            a coarser canvas shows the same texture.
    """

    width_m: float
    height_m: float
    rows: int
    columns: int
    rng: np.random.Generator

    @property
    def texel_m(self) -> float:
        """Length of a pixel's side [m]."""
        return self.height_m / self.rows

    def filled(self, color: Color) -> Image:
        """An image of one colour."""
        return np.full((self.rows, self.columns, 3), color, np.float32)

    def coordinates(self) -> tuple[Plane, Plane]:
        """Positions of the pixel centres along columns (1, W) and rows (H, 1) [m]."""
        x = (np.arange(self.columns, dtype=np.float32) + 0.5) * (self.width_m / self.columns)
        y = (np.arange(self.rows, dtype=np.float32) + 0.5) * (self.height_m / self.rows)
        return x[None, :], y[:, None]

    def noise(self, scale_m: float, octaves: int = 4, stretch: float = 1.0) -> Plane:
        """Smooth noise (H, W), about N(0, 1), of the given largest feature size [m].

        Octaves finer than two pixels are left out, so the texture carries nothing that would
        alias. `stretch` > 1 draws the features out along the columns, as grain.
        """
        total = np.zeros((self.rows, self.columns), np.float32)
        weight = 0.0
        for octave in range(octaves):
            cell_y = scale_m / 2**octave
            cell_x = cell_y * stretch
            cells = (int(self.height_m / cell_y) + 4, int(self.width_m / cell_x) + 4)
            grid = self.rng.standard_normal(cells, np.float32)
            shift_x, shift_y = self.rng.random(2)
            amplitude = 0.6**octave
            weight += amplitude**2
            # The random numbers are drawn all the same, for other sizes of canvas.
            if cell_y < 2 * self.texel_m:
                continue
            x, y = self.coordinates()
            map_x, map_y = np.meshgrid(x / cell_x + 1 + shift_x, y / cell_y + 1 + shift_y)
            layer = cv2.remap(
                grid, map_x.astype(np.float32), map_y.astype(np.float32), cv2.INTER_CUBIC
            )
            total += amplitude * layer
        # Interpolation between independent nodes lowers the deviation.
        return total / np.float32(0.65 * np.sqrt(weight))

    def softened(self, image: Image, sigma_m: float = 0.001) -> Image:
        """Edges softened as print and paint are, at least to what the pixels can carry."""
        sigma = max(sigma_m / self.texel_m, 0.6)
        return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)

    def fill(
        self, image: Image, points_m: NDArray[np.floating], color: NDArray[np.floating]
    ) -> None:
        """Fill a polygon in place; corners (N, 2) along columns and rows [m]."""
        texels = np.array([self.columns / self.width_m, self.rows / self.height_m])
        corners = np.round((np.asarray(points_m) * texels - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(image, [corners[None]], tuple(float(c) for c in color), shift=4)

    def fill_rectangle(
        self,
        image: Image,
        left: float,
        top: float,
        width: float,
        height: float,
        color: NDArray[np.floating] | Color,
    ) -> None:
        """Fill a rectangle in place, everything in metres."""
        corners = (
            np.array([left, top])
            + np.outer([0, 0, 1, 1], [width, 0])
            + np.outer([0, 1, 1, 0], [0, height])
        )
        self.fill(image, corners, np.asarray(color))


def mixed(base: Image, color: Color, share: Plane) -> Image:
    """Base with `color` laid over it in the share (H, W) of each pixel."""
    weight = np.clip(share, 0.0, 1.0).astype(np.float32)[..., None]
    mixture = (np.asarray(color, np.float32) - base) * weight
    mixture += base
    return mixture


def toned(image: Image, factor: Plane) -> Image:
    """The image made lighter or darker by a factor a pixel."""
    return np.asarray(image * factor[..., None], np.float32)


def shaded(color: Color, factor: float) -> Color:
    """A lighter or darker colour."""
    return (factor * color[0], factor * color[1], factor * color[2])


def step(values: Plane, width: float) -> Plane:
    """0 below zero, 1 above, linear over `width`."""
    return np.asarray(np.clip(values / width + 0.5, 0.0, 1.0))
