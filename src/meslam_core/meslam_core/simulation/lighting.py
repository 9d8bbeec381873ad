"""Diffuse light on every patch: soft shadows of square lamps and darker corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.simulation.scene import Lamp, Patch, Scene

NODE_SPACING_M = 0.07
LAMP_SIDE_SAMPLES = 4
SKY_SAMPLES = 32
EXPOSED_SHARE = 0.92
"""Share of all surface that is darker than full exposure; the rest is overexposed."""

CORNER_REACH_M = 0.9
"""Surfaces nearer than this take ambient light away [m]."""

LONG_M = 5.0
BORDER_SHARE, BORDER_M = 0.02, 0.02
"""How far the outer nodes lie inside a patch: a share of it, or of a long one a length [m]."""

Grid = tuple[int, int]


def bake(scene: Scene, caster: o3d.t.geometry.RaycastingScene) -> list[NDArray[np.float32]]:
    """Light on a coarse grid over each patch, exposed so that bright places show paint as it is.

    Args:
        scene: its patches, lamps and ambient light.
        caster: all surfaces of the scene.

    Returns:
        For each patch (rows, columns) float32; 1 shows the paint as it is.
    """
    grids, points, normals = [], [], []
    for patch in scene.patches:
        columns, rows = (
            int(np.ceil(length / NODE_SPACING_M)) + 1 for length in (patch.width_m, patch.height_m)
        )
        patch_points, patch_normals = _surface_at_nodes(patch, columns, rows)
        grids.append((rows, columns))
        points.append(patch_points)
        normals.append(patch_normals)
    light = _irradiance(scene, caster, np.concatenate(points), np.concatenate(normals))
    light /= np.quantile(light, EXPOSED_SHARE)
    ends = np.cumsum([rows * columns for rows, columns in grids])[:-1]
    return [
        part.reshape(grid).astype(np.float32)
        for part, grid in zip(np.split(light, ends), grids, strict=True)
    ]


def _surface_at_nodes(
    patch: Patch, columns: int, rows: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and normals (rows * columns, 3) of the grid nodes, by unrolling backwards."""
    # Nodes on the very border would fall beside the triangles or into the next wall.
    x, y = (
        np.linspace(inset, 1 - inset, count) * length
        for count, length in ((columns, patch.width_m), (rows, patch.height_m))
        for inset in [BORDER_SHARE if length <= LONG_M else BORDER_M / length]
    )
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    corners = patch.vertices[patch.triangles]
    triangle_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(triangle_normals, axis=1)
    triangles = patch.triangles[lengths > 1e-12]
    corners, triangle_normals = corners[lengths > 1e-12], triangle_normals[lengths > 1e-12]
    flat = patch.coordinates[triangles]
    origin, edges = flat[:, 0], np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], -1)
    shares = np.einsum("tij,ntj->nti", np.linalg.inv(edges), nodes[:, None] - origin)
    weights = np.concatenate([1 - shares.sum(-1, keepdims=True), shares], -1)
    # The triangle that holds the node, or the nearest where the patch is not a rectangle.
    chosen = np.argmax(weights.min(-1), axis=1)
    weights = weights[np.arange(len(nodes)), chosen].clip(0)
    weights /= weights.sum(-1, keepdims=True)
    points = np.einsum("nk,nkj->nj", weights, corners[chosen])
    normals = triangle_normals[chosen]
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _irradiance(
    scene: Scene,
    caster: o3d.t.geometry.RaycastingScene,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Ambient light that corners lack, plus what every lamp sends without being blocked."""
    start = points + 2e-3 * normals
    total = np.zeros(len(points))
    sky, (tangents, others) = _hemisphere(), _tangents(normals)
    for direction in sky:
        turned = direction[0] * tangents + direction[1] * others + direction[2] * normals
        total += scene.ambient / len(sky) * ~_blocked(caster, start, turned, CORNER_REACH_M)
    for lamp in scene.lamps:
        samples = _lamp_points(lamp)
        # A margin round the square, so that facing it is not decided by its middle alone.
        toward = lamp.center - start
        near = (toward**2).sum(1) < lamp.reach_m**2
        near &= (toward * normals).sum(1) > -lamp.side_m
        near &= toward[:, 2] > 0
        lit, facing = start[near], normals[near]
        for sample in samples:
            toward = sample - lit
            squared = (toward**2).sum(1)
            distance = np.sqrt(squared)
            received = (toward * facing).sum(1) / distance
            sent = toward[:, 2] / distance
            power = lamp.power / len(samples) * received.clip(0) * sent.clip(0) / squared.clip(0.05)
            total[near] += power * ~_blocked(caster, lit, toward, 1.0)
    return np.maximum(total, 1e-3)


def _blocked(
    caster: o3d.t.geometry.RaycastingScene,
    start: NDArray[np.float64],
    direction: NDArray[np.float64],
    reach: float,
) -> NDArray[np.bool_]:
    rays = np.concatenate([start, direction], 1).astype(np.float32)
    hit = caster.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=float(reach))
    return np.asarray(hit.numpy(), bool)


def _hemisphere() -> NDArray[np.float64]:
    """Directions (SKY_SAMPLES, 3) about +z, as dense as their cosine (a Fibonacci spiral)."""
    index = np.arange(SKY_SAMPLES) + 0.5
    radius = np.sqrt(index / SKY_SAMPLES)
    angle = np.pi * (1 + np.sqrt(5)) * index
    height = np.sqrt(1 - radius**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], 1)


def _tangents(normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors (N, 3) each that complete every normal (N, 3) to a frame."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangents = np.cross(helper, normals)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return tangents, np.cross(normals, tangents)


def _lamp_points(lamp: Lamp) -> Sequence[NDArray[np.float64]]:
    """Points spread over the lamp's square."""
    steps = ((np.arange(LAMP_SIDE_SAMPLES) + 0.5) / LAMP_SIDE_SAMPLES - 0.5) * lamp.side_m
    return [np.add(lamp.center, (x, y, 0.0)) for x in steps for y in steps]
