"""A coloured triangle mesh and its connected pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

BATCH = 1 << 18


@dataclass(frozen=True)
class TriangleMesh:
    """A surface in the map frame.

    Attributes:
        vertices: (V, 3) float32 [m].
        triangles: (T, 3) int32, counter-clockwise seen from free space.
        normals: (V, 3) float32 unit vectors into free space.
        colors: (V, 3) uint8 RGB.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]

    @property
    def triangle_areas_m2(self) -> NDArray[np.float64]:
        """Area (T,) of every triangle [m^2]."""
        areas = np.empty(len(self.triangles))
        for start in range(0, len(areas), BATCH):
            corners = self.vertices[self.triangles[start : start + BATCH]].astype(np.float64)
            edges = corners[:, 1:] - corners[:, :1]
            # Written out: numpy's cross product takes three times as long.
            (a, b, c), (d, e, f) = edges[:, 0].T, edges[:, 1].T
            squares = (b * f - c * e) ** 2 + (c * d - a * f) ** 2 + (a * e - b * d) ** 2
            areas[start : start + BATCH] = 0.5 * np.sqrt(squares)
        return areas

    def selected(self, triangles: NDArray[np.bool_]) -> TriangleMesh:
        """The mesh of some of the triangles (T,), without vertices that none of them uses."""
        kept = self.triangles[triangles]
        used = np.zeros(len(self.vertices), bool)
        used[kept] = True
        numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return TriangleMesh(
            self.vertices[used], numbers[kept], self.normals[used], self.colors[used]
        )


def without_shards(mesh: TriangleMesh, min_area_m2: float) -> TriangleMesh:
    """A mesh without the connected pieces whose surface is smaller than `min_area_m2`."""
    if min_area_m2 <= 0.0 or not len(mesh.triangles):
        return mesh
    a, b, c = mesh.triangles.T
    count = len(mesh.vertices)
    edges = coo_matrix(
        (np.ones(2 * len(a), bool), (np.concatenate([a, b]), np.concatenate([b, c]))),
        shape=(count, count),
    )
    _, labels = connected_components(edges, directed=False)
    areas = np.bincount(labels[a], weights=mesh.triangle_areas_m2, minlength=labels.max() + 1)
    return mesh.selected(areas[labels[a]] >= min_area_m2)
