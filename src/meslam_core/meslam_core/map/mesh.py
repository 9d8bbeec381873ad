"""The blended field's surface as a coloured triangle mesh, by marching cubes (Sec. II-D)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from meslam_core.errors import MapError
from meslam_core.map.lattice import cell_numbers, true_cells, unique_cells
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.triangle_mesh import TriangleMesh, without_shards
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

LATTICE_REACH = 1 << 19
BLOCK = 8
TILE_BLOCKS = 12
COARSE = 2
MAX_SLOPE = 1.5
MIN_MARGIN = 1e-3
MAX_REFINEMENT_VOXELS = 0.5
MIN_SHARD_M2 = 0.01

Progress = Callable[[int, int], None]


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
        regions: only what they saw in their boxes, and outside of all boxes; others blend in.
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
    tiles = _tiles(_near_blocks(neural_map, chosen, resolution, box))
    builder = _Builder(neural_map, chosen, resolution)
    for number, blocks in enumerate(tiles):
        builder.add(blocks)
        if progress is not None:
            progress(number + 1, len(tiles))
    mesh = _seen_from_front(builder.mesh(), neural_map)
    if box is not None:
        inside = np.all((mesh.vertices >= box[0]) & (mesh.vertices <= box[1]), axis=1)
        mesh = mesh.selected(np.all(inside[mesh.triangles], axis=1))
    return without_shards(mesh, min_shard_m2)


def _seen_from_front(mesh: TriangleMesh, neural_map: NeuralMap) -> TriangleMesh:
    """A mesh without surfaces that face space nobody saw.

    A little more is marked as observed behind a surface than was trained; the field may cross
    the level there again, which makes a false back to the wall.
    """
    ahead = mesh.vertices.astype(np.float64)
    ahead += mesh.normals * max(region.stored.mask.voxel_m for region in neural_map.regions)
    seen = neural_map.flags(ahead) & OBSERVED > 0
    return mesh.selected(np.all(seen[mesh.triangles], axis=1))


def _near_blocks(
    neural_map: NeuralMap,
    regions: list[PlacedRegion],
    resolution: float,
    box: tuple[NDArray[np.floating], NDArray[np.floating]] | None,
) -> NDArray[np.int64]:
    """Blocks (N, 3) of BLOCK cubes a side that may hold a surface that a region tells of."""
    side = BLOCK * resolution
    found = [np.zeros((0, 3), np.int64)]
    for region in regions:
        mask = region.stored.mask
        centers = region.observed_centers(near_surface=True)
        if len(regions) < len(neural_map.regions):
            centers = centers[neural_map.assigned(region, centers, mask.voxel_m)]
        if not len(centers):
            continue
        reach = 0.5 * mask.voxel_m * np.abs(region.rotation).sum(axis=1) + resolution
        low = np.floor((centers - reach) / side).astype(np.int64)
        high = np.floor((centers + reach) / side).astype(np.int64)
        first = low.min(axis=0)
        near = np.zeros(high.max(axis=0) - first + 1, bool)
        for step in product(*(range(int(n) + 1) for n in (high - low).max(axis=0))):
            near[tuple((np.minimum(low + np.array(step), high) - first).T)] = True
        found.append(np.argwhere(near) + first)
    blocks = unique_cells(np.concatenate(found))
    if box is not None:
        above = (blocks + 1) * side >= np.asarray(box[0])
        blocks = blocks[(above & (blocks * side <= np.asarray(box[1]))).all(axis=1)]
    return blocks


def _tiles(blocks: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Blocks (N, 3) by the tile they belong to."""
    numbers = cell_numbers(blocks // TILE_BLOCKS)
    return [blocks[numbers == number] for number in np.unique(numbers)]


class _Builder:
    """Runs marching cubes tile by tile and joins the tiles' meshes.

    Tiles share the lattice points on their faces, so that a vertex on a face is found by both
    tiles on the same lattice edge, which joins them. Where the box that holds a tile's blocks is
    smaller than the tile, nothing is shared.
    """

    def __init__(
        self, neural_map: NeuralMap, chosen: list[PlacedRegion], resolution: float
    ) -> None:
        self._map = neural_map
        self._all = len(chosen) == len(neural_map.regions)
        self._chosen = chosen
        self._resolution = resolution
        self._mask_voxel_m = min(region.stored.mask.voxel_m for region in chosen)
        self._shared: list[NDArray[np.int64]] = []
        self._triangles: list[NDArray[np.int64]] = []
        self._parts: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]] = []
        self._count = 0

    def add(self, blocks: NDArray[np.int64]) -> None:
        """March through the blocks (N, 3) of one tile, in the box that holds them."""
        lowest = blocks.min(axis=0)
        first = lowest * BLOCK
        wanted = np.zeros(blocks.max(axis=0) - lowest + 1, bool)
        wanted[tuple((blocks - lowest).T)] = True
        cells = _enlarged(wanted, BLOCK // COARSE)
        if 2 * COARSE * self._resolution <= self._mask_voxel_m:
            cells = self._crossed(self._evaluate(cells, first, COARSE), cells)
        cells = _enlarged(cells, COARSE)
        if cells.any():
            self._march(self._evaluate(cells, first, 1), cells, first)

    def _evaluate(
        self, cells: NDArray[np.bool_], first: NDArray[np.int64], stride: int
    ) -> NDArray[np.float32]:
        """f over the surface level at the corners (a + 1, b + 1, c + 1) of cells (a, b, c).

        NaN where nothing was seen near a surface, or no cell asks.

        Args:
            cells: whose corners are wanted.
            first: (3,) lattice point of the lowest corner.
            stride: lattice steps from corner to corner.
        """
        corners = np.zeros([side + 1 for side in cells.shape], bool)
        for corner in _corners(cells.shape):
            corners[corner] |= cells
        lattice = true_cells(corners)
        points = (lattice * stride + first) * self._resolution
        answer = self._map.values(points, near_only=True)
        values = answer.distance - np.float32(self._map.surface_level)
        # Keeps vertices off lattice points, where it is open which edge they lie on.
        values = np.where(values < 0.0, np.minimum(values, -MIN_MARGIN), values)
        values = np.where(values >= 0.0, np.maximum(values, MIN_MARGIN), values)
        field = np.full(corners.shape, np.nan, np.float32)
        field[tuple(lattice.T)] = np.where(self._near(points, answer.flags), values, np.nan)
        return field

    def _crossed(self, field: NDArray[np.float32], cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which coarse cells the surface may cross, judged by the values at their corners.

        No point of a cell is farther from a corner than half its diagonal; where every corner
        is farther than that from the surface, on one side of it, the cell holds none.
        """
        reach_m = 0.5 * np.sqrt(3.0) * COARSE * self._resolution * MAX_SLOPE
        reach = np.float32(reach_m / self._map.truncation_m)
        before, behind = np.zeros_like(cells), np.zeros_like(cells)
        for corner in _corners(cells.shape):
            before |= field[corner] < reach
            behind |= field[corner] > -reach
        crossed: NDArray[np.bool_] = cells & before & behind
        return crossed

    def _near(self, points: NDArray[np.floating], flags: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which points (N, 3) are near a surface, for a chosen region; `flags` are any region's."""
        if self._all:
            return flags & NEAR_SURFACE > 0
        near = np.zeros(len(points), bool)
        for region in self._chosen:
            seen = np.flatnonzero(region.lookup(region.to_local(points)) & NEAR_SURFACE)
            near[seen] |= self._map.assigned(region, points[seen])
        return near

    def _march(
        self, field: NDArray[np.float32], cells: NDArray[np.bool_], first: NDArray[np.int64]
    ) -> None:
        """Triangles of the cells whose corners are all known."""
        known = np.isfinite(field)
        for corner in _corners(cells.shape):
            cells = cells & known[corner]
        field = np.where(known, field, np.float32(-1.0))
        # skimage asks for a cell at its upper corner.
        mask = np.zeros(field.shape, bool)
        mask[1:, 1:, 1:] = cells
        if not cells.any() or field.max() < 0.0 or field.min() > 0.0:
            return
        try:
            vertices, triangles, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
                field, 0.0, mask=mask
            )
        except (ValueError, RuntimeError):  # no cell holds a surface
            return
        vertices = vertices.astype(np.float64)
        shared = np.flatnonzero(_on_face(vertices, cells.shape))
        edges = _edge_numbers(vertices[shared], first)
        self._shared.append(np.stack([edges, shared + self._count]))
        # skimage winds them clockwise seen from the lower values, which are free space.
        self._triangles.append(triangles[:, ::-1].astype(np.int32) + np.int32(self._count))
        self._count += len(vertices)
        self._parts.append(self._finished((vertices + first) * self._resolution))

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
                np.zeros((0, 3), np.float32),
                np.zeros((0, 3), np.int32),
                np.zeros((0, 3), np.float32),
                np.zeros((0, 3), np.uint8),
            )
        edges, shared = np.concatenate(self._shared, axis=1)
        _, first, number = np.unique(edges, return_index=True, return_inverse=True)
        joined = np.arange(self._count, dtype=np.int32)
        joined[shared] = shared[first][number]
        triangles = joined[np.concatenate(self._triangles)]
        a, b, c = triangles.T
        proper = (a != b) & (b != c) & (c != a)
        columns = zip(*self._parts, strict=True)
        vertices, normals, colors = (np.concatenate(column) for column in columns)
        return TriangleMesh(vertices, triangles, normals, colors).selected(proper)


def _corners(shape: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """The lattice points at each of the eight corners of all cells of a box."""
    for step in product((0, 1), repeat=3):
        yield tuple(slice(s, s + side) for s, side in zip(step, shape, strict=True))


def _enlarged(cells: NDArray[np.bool_], factor: int) -> NDArray[np.bool_]:
    """Every cell (a, b, c) as factor^3 cells."""
    result: NDArray[np.bool_] = cells.repeat(factor, 0).repeat(factor, 1).repeat(factor, 2)
    return result


def _on_face(vertices: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which vertices (V, 3) of a box lie on its faces, where other boxes have them too."""
    margin = 0.25 * MIN_MARGIN
    outermost = (vertices < margin) | (vertices > np.array(shape) - margin)
    return np.asarray(outermost.any(axis=1), np.bool_)


def _edge_numbers(vertices: NDArray[np.float64], first: NDArray[np.int64]) -> NDArray[np.int64]:
    """The lattice edge each vertex lies on, the same number in every tile.

    Args:
        vertices: (V, 3) on lattice edges, in lattice steps from `first`.
        first: (3,) lattice point of the tile's lowest corner.
    """
    nearest = np.rint(vertices)
    axis = np.abs(vertices - nearest).argmax(axis=1)
    rows = np.arange(len(vertices))
    lower = nearest.astype(np.int64) + first
    lower[rows, axis] = np.floor(vertices[rows, axis]).astype(np.int64) + first[axis]
    x, y, z = (lower + LATTICE_REACH).T
    return np.asarray((((x * 2 * LATTICE_REACH + y) * 2 * LATTICE_REACH) + z) * 3 + axis)
