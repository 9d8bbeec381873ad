"""The blended field's surface as a coloured triangle mesh, by marching cubes (Sec. II-D)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from meslam_core.errors import MapError
from meslam_core.map.neural_map import NeuralMap, PlacedRegion
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE

BLOCK = 8
TILE_BLOCKS = 12
MIN_MARGIN = 1e-3
MAX_REFINEMENT_VOXELS = 0.5
MIN_SHARD_M2 = 0.01

Progress = Callable[[int, int], None]
Block = tuple[int, int, int]


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
        corners = self.vertices.astype(np.float64)[self.triangles]
        edges = corners[:, 1:] - corners[:, :1]
        return 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)

    def selected(self, triangles: NDArray[np.bool_]) -> TriangleMesh:
        """The mesh of some of the triangles (T,), without vertices that none of them uses."""
        kept = self.triangles[triangles]
        used = np.zeros(len(self.vertices), bool)
        used[kept] = True
        numbers = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return TriangleMesh(
            self.vertices[used], numbers[kept], self.normals[used], self.colors[used]
        )


def extract_mesh(
    neural_map: NeuralMap,
    resolution_m: float | None = None,
    *,
    box: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None,
    regions: Iterable[RegionIndex] | None = None,
    min_shard_m2: float = MIN_SHARD_M2,
    progress: Progress | None = None,
) -> TriangleMesh:
    """The mesh of the map's observed surfaces.

    Only the neighbourhood of measured surfaces is evaluated, tile by tile, so that memory does
    not grow with the map but for the mesh itself. Vertices lie on a lattice that is the same
    for every selection, moved onto the surface by one Newton step.

    Args:
        neural_map: to ask.
        resolution_m: edge of a marching cube [m]; by default the map configuration's.
        box: lowest and highest corner (3,) of the part wanted, map frame [m].
        regions: only what these regions saw near a surface; others still blend in.
        min_shard_m2: disconnected pieces with less surface are dropped [m^2].
        progress: called with the number of tiles done and their total.

    Raises:
        MapError: for a resolution that makes no sense, an empty box or unknown regions.
    """
    resolution = neural_map.config.mesh_resolution_m if resolution_m is None else resolution_m
    if not 1e-3 <= resolution <= 1.0:
        raise MapError(f"a mesh resolution of {resolution} m is outside 0.001 to 1 m")
    if box is not None and not (np.asarray(box[0]) < np.asarray(box[1])).all():
        raise MapError(f"the box from {box[0]} to {box[1]} is empty; give its lowest corner first")
    chosen = neural_map.regions if regions is None else neural_map.subset(regions)
    tiles = _tiles(_near_blocks(chosen, resolution, box))
    builder = _Builder(neural_map, chosen, resolution)
    for number, (tile, blocks) in enumerate(sorted(tiles.items())):
        builder.add(tile, blocks)
        if progress is not None:
            progress(number + 1, len(tiles))
    mesh = builder.mesh()
    if box is not None:
        inside = ((mesh.vertices >= box[0]) & (mesh.vertices <= box[1])).all(axis=1)
        mesh = mesh.selected(inside[mesh.triangles].all(axis=1))
    return without_shards(mesh, min_shard_m2)


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


def _near_blocks(
    regions: Iterable[PlacedRegion],
    resolution: float,
    box: tuple[NDArray[np.floating], NDArray[np.floating]] | None,
) -> NDArray[np.int64]:
    """Blocks (N, 3) of BLOCK cubes a side that may hold a surface some region saw near it."""
    side = BLOCK * resolution
    found = [np.zeros((0, 3), np.int64)]
    for region in regions:
        mask = region.stored.mask
        local = (np.argwhere(mask.flags & NEAR_SURFACE) + 0.5) * mask.voxel_m - mask.half_extent_m
        centers = local @ region.rotation.T + region.center
        reach = 0.5 * mask.voxel_m * np.abs(region.rotation).sum(axis=1) + resolution
        low = np.floor((centers - reach) / side).astype(np.int64)
        spread = np.floor((centers + reach) / side).astype(np.int64) - low
        for step in product(*(range(int(n) + 1) for n in spread.max(axis=0, initial=0))):
            found.append(np.unique((low + np.array(step))[(spread >= step).all(axis=1)], axis=0))
    blocks = np.unique(np.concatenate(found), axis=0)
    if box is not None:
        above = (blocks + 1) * side >= np.asarray(box[0])
        blocks = blocks[(above & (blocks * side <= np.asarray(box[1]))).all(axis=1)]
    return blocks


def _tiles(blocks: NDArray[np.int64]) -> dict[Block, NDArray[np.int64]]:
    """Blocks (N, 3) by the tile they belong to."""
    if not len(blocks):
        return {}
    tiles, member = np.unique(blocks // TILE_BLOCKS, axis=0, return_inverse=True)
    member = member.reshape(-1)
    return {
        (int(x), int(y), int(z)): blocks[member == number]
        for number, (x, y, z) in enumerate(tiles)
    }


class _Builder:
    """Runs marching cubes tile by tile and joins the tiles' meshes.

    Tiles share the lattice points on their faces, so that a vertex on a face is found by both
    tiles on the same lattice edge, which joins them.
    """

    def __init__(
        self, neural_map: NeuralMap, chosen: list[PlacedRegion], resolution: float
    ) -> None:
        self._map = neural_map
        self._all = len(chosen) == len(neural_map.regions)
        self._chosen = chosen
        self._resolution = resolution
        self._edges: list[NDArray[np.int64]] = []
        self._triangles: list[NDArray[np.int64]] = []
        self._parts: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]] = []
        self._count = 0

    def add(self, tile: Block, blocks: NDArray[np.int64]) -> None:
        """March through the blocks of one tile."""
        first = np.array(tile) * (TILE_BLOCKS * BLOCK)
        side = TILE_BLOCKS * BLOCK + 1
        wanted = np.zeros((TILE_BLOCKS,) * 3, bool)
        wanted[tuple((blocks - np.array(tile) * TILE_BLOCKS).T)] = True
        cells = wanted.repeat(BLOCK, 0).repeat(BLOCK, 1).repeat(BLOCK, 2)
        corners = np.zeros((side,) * 3, bool)
        for step in product((0, 1), repeat=3):
            corners[tuple(slice(s, s + side - 1) for s in step)] |= cells
        lattice = np.argwhere(corners)
        points = (lattice + first) * self._resolution
        near = self._near(points)
        lattice, points = lattice[near], points[near]
        values = self._map.values(points).distance - self._map.surface_level
        # Keeps vertices off lattice points, where it is open which edge they lie on.
        values = np.where(values < 0.0, np.minimum(values, -MIN_MARGIN), values)
        values = np.where(values >= 0.0, np.maximum(values, MIN_MARGIN), values)
        field = np.full((side,) * 3, np.nan, np.float32)
        field[tuple(lattice.T)] = values
        self._march(field, cells, first)

    def _near(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (N, 3) a chosen region saw near a surface."""
        if self._all:
            return (self._map.flags(points) & NEAR_SURFACE) > 0
        near = np.zeros(len(points), bool)
        for region in self._chosen:
            near |= (region.lookup(region.to_local(points)) & NEAR_SURFACE) > 0
        return near

    def _march(
        self, field: NDArray[np.float32], cells: NDArray[np.bool_], first: NDArray[np.int64]
    ) -> None:
        known = np.isfinite(field)
        for step in product((0, 1), repeat=3):
            cells = cells & known[tuple(slice(s, s + cells.shape[0]) for s in step)]
        field = np.where(known, field, np.float32(-1.0))
        if not cells.any() or field.max() < 0.0:
            return
        # skimage asks for a cell at its upper corner.
        mask = np.zeros(field.shape, bool)
        mask[1:, 1:, 1:] = cells
        try:
            vertices, triangles, _, _ = marching_cubes(field, 0.0, mask=mask)
        except (ValueError, RuntimeError):  # no cell holds a surface
            return
        vertices = vertices.astype(np.float64) + first
        self._edges.append(_edge_keys(vertices, self._count))
        # skimage winds them clockwise seen from the lower values, which are free space.
        self._triangles.append(triangles[:, ::-1].astype(np.int64) + self._count)
        self._count += len(vertices)
        self._parts.append(self._finished(vertices * self._resolution))

    def _finished(
        self, vertices: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """Vertices moved onto the surface, their normals and colours."""
        values, gradient = self._map.gradient(vertices)
        slope = np.linalg.norm(gradient, axis=1, keepdims=True)
        normals = -gradient / np.maximum(slope, 1e-6)
        step = (values.distance - self._map.surface_level)[:, None] / np.maximum(slope, 1e-6)
        limit = MAX_REFINEMENT_VOXELS * self._resolution
        step = np.nan_to_num(np.clip(step, -limit, limit))
        colors = np.clip(np.nan_to_num(values.color) * 255.0 + 0.5, 0, 255).astype(np.uint8)
        moved = vertices + step * np.nan_to_num(normals)
        return moved.astype(np.float32), np.nan_to_num(normals), colors

    def mesh(self) -> TriangleMesh:
        """All tiles' meshes as one, vertices on shared edges joined."""
        if not self._parts:
            return TriangleMesh(
                np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32),
                np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8),
            )
        edges = np.concatenate(self._edges)
        _, kept, number = np.unique(edges, axis=0, return_index=True, return_inverse=True)
        vertices, normals, colors = (np.concatenate(part)[kept] for part in zip(*self._parts))
        triangles = number.reshape(-1)[np.concatenate(self._triangles)].astype(np.int32)
        a, b, c = triangles.T
        proper = (a != b) & (b != c) & (c != a)
        return TriangleMesh(vertices, triangles[proper], normals, colors)


def _edge_keys(vertices: NDArray[np.float64], start: int) -> NDArray[np.int64]:
    """A key (V, 4) of the lattice edge each vertex lies on: its lower end and its axis.

    Marching cubes also makes vertices inside cells; no other tile has those, they get a number
    of their own.
    """
    nearest = np.rint(vertices)
    off = np.abs(vertices - nearest)
    axis = off.argmax(axis=1)
    rows = np.arange(len(vertices))
    lower = nearest.astype(np.int64)
    lower[rows, axis] = np.floor(vertices[rows, axis]).astype(np.int64)
    inner = np.sort(off, axis=1)[:, 1] > 0.25 * MIN_MARGIN
    keys = np.concatenate([lower, axis[:, None]], axis=1)
    keys[inner] = 0
    keys[inner, 0] = start + rows[inner]
    keys[inner, 3] = 3
    return keys


def block_count(neural_map: NeuralMap, resolution_m: float) -> int:
    """Number of blocks that a mesh of the whole map looks at."""
    return len(_near_blocks(neural_map.regions, resolution_m, None))


def triangle_batches(mesh: TriangleMesh, size: int) -> Iterator[NDArray[np.int32]]:
    """The triangles in batches of at most `size`, for messages of limited length."""
    return (mesh.triangles[start : start + size] for start in range(0, len(mesh.triangles), size))
