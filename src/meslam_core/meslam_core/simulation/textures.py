"""Procedural textures: each paints one flat patch of a surface, the same at every resolution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from meslam_core.simulation.canvas import Canvas, Color, Image, mixed, shaded, step, toned

Texture = Callable[[Canvas], Image]


def plaster(color: Color, roughness: float = 0.03) -> Texture:
    """A painted wall: uneven paint, faint stains and fine grain."""

    def paint(canvas: Canvas) -> Image:
        tone = 1 + roughness * canvas.noise(0.8, 3) + 0.7 * roughness * canvas.noise(0.03, 2)
        stains = step(canvas.noise(0.35, 4) - 1.6, 0.8)
        darker = shaded(color, 0.77)
        return toned(mixed(canvas.filled(color), darker, 0.4 * stains), tone)

    return paint


def wallpaper(ground: Color, figure: Color, period_m: float = 0.22) -> Texture:
    """Vertical stripes with a printed figure in every second one."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        soft = max(0.004, 1.5 * canvas.texel_m)
        stripe = step(np.abs((x / period_m) % 1 - 0.5) * period_m - period_m / 4, soft)
        column = np.floor(x / period_m)
        local_x = (x / period_m) % 1 - 0.5
        local_y = (y / period_m + 0.5 * (column % 2)) % 1 - 0.5
        radius = np.hypot(local_x, local_y)
        angle = np.arctan2(local_y, local_x)
        petals = step((0.17 + 0.07 * np.cos(5 * angle) - radius) * period_m, soft)
        image = canvas.filled(ground)
        image = mixed(image, shaded(ground, 0.86), np.broadcast_to(stripe, petals.shape))
        image = mixed(image, figure, petals)
        wear = 1 + 0.04 * canvas.noise(0.6, 4)
        return toned(image, wear)

    return paint


def bricks(color: Color, mortar: Color = (0.72, 0.70, 0.66)) -> Texture:
    """A brick wall in running bond, every brick of its own tint."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        length, height, joint = 0.22, 0.075, 0.012
        row = np.floor(y / height)
        shifted = x + 0.5 * length * (row % 2)
        column = np.floor(shifted / length)
        rows, columns = int(row.max()) + 1, int(column.max()) + 1
        tints = canvas.rng.normal(1.0, 0.14, (rows, columns, 1)) + canvas.rng.normal(
            0, 0.03, (rows, columns, 3)
        )
        tint = tints.astype(np.float32)[
            np.broadcast_to(row, column.shape).astype(int), column.astype(int)
        ]
        edge_x = np.minimum(shifted % length, length - shifted % length)
        edge_y = np.minimum(y % height, height - y % height)
        face = step(np.minimum(edge_x, edge_y) - joint / 2, max(0.004, 1.5 * canvas.texel_m))
        grain = 1 + 0.10 * canvas.noise(0.05, 4)
        image = toned(canvas.filled(color) * tint, grain)
        return mixed(image, mortar, 1 - face)

    return paint


def wood(color: Color, contrast: float = 0.16) -> Texture:
    """Grain along the columns."""

    def paint(canvas: Canvas) -> Image:
        warp = canvas.noise(0.12, 3, stretch=8.0)
        _, y = canvas.coordinates()
        rings = np.sin(2 * np.pi * (y / 0.03 + 0.8 * warp))
        fibre = canvas.noise(0.008, 2, stretch=20.0)
        tone = 1 + contrast * (0.5 * rings + 0.45 * fibre + 0.35 * warp)
        return toned(canvas.filled(color), tone)

    return paint


def planks(color: Color, width_m: float = 0.14, length_m: float = 1.2) -> Texture:
    """A floor of boards along the columns, each with its own tint and grain."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        row = np.floor(y / width_m)
        offsets = canvas.rng.random(int(row.max()) + 1).astype(np.float32) * length_m
        shifted = x + offsets[row.astype(int)]
        column = np.floor(shifted / length_m)
        shape = (int(row.max()) + 1, int(column.max()) + 1)
        tints = canvas.rng.normal(1.0, 0.10, shape).astype(np.float32)
        tint = tints[np.broadcast_to(row, column.shape).astype(int), column.astype(int)]
        edge = np.minimum(
            np.minimum(y % width_m, width_m - y % width_m),
            np.minimum(shifted % length_m, length_m - shifted % length_m),
        )
        gap = 1 - step(edge - 0.0025, max(0.003, 1.5 * canvas.texel_m))
        tone = tint * (1 + 0.09 * canvas.noise(0.03, 3, stretch=12.0))
        image = toned(canvas.filled(color), tone)
        return mixed(image, shaded(color, 0.35), gap)

    return paint


def rug(ground: Color, second: Color, third: Color) -> Texture:
    """A woven rug: a border and rows of lozenges and zigzags."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        soft = max(0.006, 1.5 * canvas.texel_m)
        lozenge = np.abs((x / 0.24) % 1 - 0.5) + np.abs((y / 0.32) % 1 - 0.5)
        zigzag = np.abs((x / 0.12) % 1 - 0.5) * 0.12 + (y % 0.32) - 0.27
        image = mixed(canvas.filled(ground), second, step((0.32 - lozenge) * 0.24, soft))
        image = mixed(image, third, step((0.15 - lozenge) * 0.24, soft))
        image = mixed(image, third, step(0.014 - np.abs(zigzag), soft))
        border = np.minimum(np.minimum(x, canvas.width_m - x), np.minimum(y, canvas.height_m - y))
        image = mixed(image, second, step(0.10 - border, soft) * step(border - 0.03, soft))
        weave = 1 + 0.07 * canvas.noise(0.012, 2) + 0.05 * canvas.noise(0.25, 3)
        return toned(image, weave)

    return paint


def fabric(color: Color, stripe: Color | None = None) -> Texture:
    """Cloth with a soft weave and, with a second colour, a plaid."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        soft = max(0.004, 1.5 * canvas.texel_m)
        image = canvas.filled(color)
        if stripe is not None:
            bars = 0.45 * step(0.025 - np.abs(x % 0.16 - 0.08), soft)
            bars = bars + 0.45 * step(0.025 - np.abs(y % 0.16 - 0.08), soft)
            image = mixed(image, stripe, bars)
        folds = 1 + 0.06 * canvas.noise(0.3, 3) + 0.06 * canvas.noise(0.01, 2)
        return toned(image, folds)

    return paint


def checker(first: Color, second: Color, tile_m: float) -> Texture:
    """Tiles in two colours, slightly uneven."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        soft = 1.5 * canvas.texel_m
        wave_x = step((np.abs((x / tile_m) % 2 - 1) - 0.5) * tile_m, soft)
        wave_y = step((np.abs((y / tile_m) % 2 - 1) - 0.5) * tile_m, soft)
        parity = wave_x + wave_y - 2 * wave_x * wave_y
        image = mixed(canvas.filled(first), second, parity)
        return toned(image, 1 + 0.05 * canvas.noise(0.06, 3))

    return paint


def marbled(color: Color, vein: Color, scale_m: float = 0.08) -> Texture:
    """Noise between two colours, for objects without a direction."""

    def paint(canvas: Canvas) -> Image:
        veins = np.abs(canvas.noise(scale_m, 4))
        image = mixed(canvas.filled(color), vein, 1.1 - 1.4 * veins)
        return toned(image, 1 + 0.05 * canvas.noise(0.02, 2))

    return paint


def cardboard() -> Texture:
    """A brown carton with tape and a printed label."""

    def paint(canvas: Canvas) -> Image:
        image = toned(canvas.filled((0.66, 0.50, 0.34)), 1 + 0.04 * canvas.noise(0.05, 4))
        x, _ = canvas.coordinates()
        middle = np.broadcast_to(np.abs(x - canvas.width_m / 2), image.shape[:2])
        image = mixed(image, (0.80, 0.72, 0.55), 0.8 * step(0.025 - middle, 0.004))
        left = canvas.rng.uniform(0.05, 0.45) * canvas.width_m
        top = canvas.rng.uniform(0.15, 0.50) * canvas.height_m
        _draw_label(canvas, image, left, top, 0.4 * canvas.width_m, 0.35 * canvas.height_m)
        return canvas.softened(image)

    return paint


def poster() -> Texture:
    """A print: a gradient, overlapping shapes, a headline and lines of text."""

    def paint(canvas: Canvas) -> Image:
        rng = canvas.rng
        top, bottom = rng.uniform(0.1, 0.95, (2, 3))
        image = mixed(
            canvas.filled(tuple(top)), tuple(bottom), np.linspace(0, 1, canvas.rows)[:, None]
        )
        for _ in range(14):
            center = rng.uniform(0, 1, 2) * (canvas.width_m, canvas.height_m)
            color = rng.uniform(0, 1, 3)
            if rng.random() < 0.5:
                radius = rng.uniform(0.04, 0.22) * canvas.width_m
                points = center + radius * np.stack(
                    [np.cos(a := np.linspace(0, 2 * np.pi, 40)), np.sin(a)], 1
                )
            else:
                points = center + rng.uniform(-0.3, 0.3, (3, 2)) * canvas.width_m
            canvas.fill(image, points, color)
        label_height = rng.uniform(0.18, 0.28) * canvas.height_m
        label_top = (0.06 if rng.random() < 0.5 else 0.70) * canvas.height_m
        _draw_label(
            canvas, image, 0.1 * canvas.width_m, label_top, 0.8 * canvas.width_m, label_height
        )
        return canvas.softened(image)

    return paint


def book_spine() -> Texture:
    """The back of a book: a cloth colour, bands and a title along it."""

    def paint(canvas: Canvas) -> Image:
        rng, width, height = canvas.rng, canvas.width_m, canvas.height_m
        color = rng.uniform(0.12, 0.85, 3)
        ink = np.clip(1.1 - color + rng.uniform(-0.15, 0.15, 3), 0, 1)
        image = canvas.filled(tuple(color))
        image = toned(image, 1 + 0.05 * canvas.noise(0.03, 3))
        for fraction in (0.1, 0.16, 0.88):
            canvas.fill_rectangle(image, 0, fraction * height, width, 0.025 * height, ink)
        position = 0.24
        while position < 0.78:
            length = rng.uniform(0.015, 0.06)
            canvas.fill_rectangle(
                image, 0.3 * width, position * height, 0.4 * width, length * height, ink
            )
            position += length + 0.02
        return canvas.softened(image)

    return paint


def window_view() -> Texture:
    """A bright sky over hills behind a wooden cross."""

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.coordinates()
        sky = np.clip(y / canvas.height_m, 0, 1)
        image = mixed(canvas.filled((0.62, 0.78, 0.98)), (0.95, 0.96, 0.98), sky)
        image = mixed(image, (1.0, 1.0, 1.0), 0.8 * step(canvas.noise(0.4, 5) - 0.5, 0.8))
        ridge = canvas.height_m * (0.62 + 0.05 * np.sin(9 * x) + 0.03 * np.sin(23 * x + 1))
        image = mixed(image, (0.28, 0.46, 0.24), step(y - ridge, 0.01))
        leaves = 1 + 0.25 * canvas.noise(0.06, 4) * (y > ridge)
        image = toned(image, leaves)
        bars = np.minimum(
            np.minimum(np.abs(x - canvas.width_m / 2), np.minimum(x, canvas.width_m - x)),
            np.minimum(np.abs(y - canvas.height_m / 2), np.minimum(y, canvas.height_m - y)),
        )
        return mixed(image, (0.80, 0.76, 0.70), step(0.03 - bars, 0.006))

    return paint


def _draw_label(
    canvas: Canvas, image: Image, left: float, top: float, width: float, height: float
) -> None:
    """A light rectangle with a bold line and lines of words; everything in metres."""
    rng = canvas.rng
    canvas.fill_rectangle(image, left, top, width, height, (0.93, 0.92, 0.88))
    canvas.fill_rectangle(
        image,
        left + 0.06 * width,
        top + 0.10 * height,
        0.7 * width,
        0.16 * height,
        (0.12, 0.12, 0.15),
    )
    for line in range(4):
        y = top + (0.36 + 0.15 * line) * height
        x = left + 0.06 * width
        while x < left + 0.85 * width:
            word = min(rng.uniform(0.05, 0.16) * width, left + 0.94 * width - x)
            canvas.fill_rectangle(image, x, y, word, 0.07 * height, (0.25, 0.25, 0.28))
            x += word + 0.03 * width
