"""The maps that grow with the surface: Open3D's TSDF and a point cloud, from given poses."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.se3 import Pose, inverse

BLOCK_VOXELS = 8
FIRST_BLOCKS = 10_000
# Open3D's own: surfaces seen less often are taken for noise.
MIN_WEIGHT = 3.0


@dataclass(frozen=True)
class Content:
    """What would be written of a map.

    Attributes:
        arrays: tightly packed, without any header.
    """

    arrays: Sequence[NDArray[Any]]

    @property
    def bytes(self) -> int:
        """As it is."""
        return sum(array.nbytes for array in self.arrays)

    @property
    def deflated_bytes(self) -> int:
        """Losslessly compressed, as a zip file does it."""
        return sum(_deflated(array) for array in self.arrays)


def _deflated(array: NDArray[Any]) -> int:
    packer = zlib.compressobj(6)
    return len(packer.compress(np.ascontiguousarray(array).data)) + len(packer.flush())


class TsdfVolume:
    """Open3D's sparse voxel blocks: distance, weight and colour, in the types of its SLAM.

    Args:
        voxel_m: side of a voxel [m].
        truncation_m: distance at which the signed distance saturates [m].
        max_depth_m: farther measurements are ignored [m].
    """

    def __init__(self, voxel_m: float, truncation_m: float, max_depth_m: float) -> None:
        self._limits = (1.0, max_depth_m, truncation_m / voxel_m)
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (o3d.core.float32, o3d.core.uint16, o3d.core.uint16),
            ((1,), (1,), (3,)),
            voxel_m,
            BLOCK_VOXELS,
            FIRST_BLOCKS,
        )

    def add(
        self,
        depth_m: NDArray[np.float32],
        color: NDArray[np.uint8],
        camera: PinholeCamera,
        T_map_camera: Pose,
    ) -> None:
        """Integrate an image pair; a depth of 0 is none."""
        depth = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth_m)))
        colors = o3d.t.geometry.Image(o3d.core.Tensor(color.astype(np.float32) / 255.0))
        # Open3D cuts projected coordinates off where the nearest pixel is meant.
        intrinsics = camera.matrix
        intrinsics[:2, 2] += 0.5
        place = (o3d.core.Tensor(intrinsics), o3d.core.Tensor(inverse(T_map_camera)))
        blocks = self._grid.compute_unique_block_coordinates(depth, *place, *self._limits)
        self._grid.integrate(blocks, depth, colors, *place, *self._limits)

    def mesh(self) -> o3d.geometry.TriangleMesh:
        """The surface that was seen often enough."""
        return self._grid.extract_triangle_mesh(weight_threshold=MIN_WEIGHT).to_legacy()

    def content(self) -> Content:
        """The blocks in use: their places, and all their voxels."""
        table = self._grid.hashmap()
        used = table.active_buf_indices().to(o3d.core.int64)
        arrays = [table.key_tensor()[used].numpy()]
        arrays += [table.value_tensor(number)[used].numpy() for number in range(3)]
        return Content(arrays)


def mesh_content(mesh: o3d.geometry.TriangleMesh) -> Content:
    """Positions and corners in four bytes each, colours in one, as a binary PLY without normals."""
    return Content(
        [
            np.asarray(mesh.vertices).astype(np.float32),
            np.round(255.0 * np.asarray(mesh.vertex_colors)).astype(np.uint8),
            np.asarray(mesh.triangles).astype(np.int32),
        ]
    )


class PointCloud:
    """One coloured point in every cube of a lattice: the first that was measured there.

    Args:
        bounds: (2, 3) lowest and highest corner of what may be measured [m].
        spacing_m: side of a cube [m].
        pixel_step: every so many pixels are used along rows and columns.
    """

    def __init__(self, bounds: NDArray[np.floating], spacing_m: float, pixel_step: int) -> None:
        self._low, self._spacing_m, self._step = bounds[0], spacing_m, pixel_step
        self._extent = np.ceil((bounds[1] - bounds[0]) / spacing_m).astype(np.int64)
        self._taken = np.zeros(int(self._extent.prod()), bool)
        self._points: list[NDArray[np.float32]] = []
        self._colors: list[NDArray[np.uint8]] = []

    def add(
        self,
        depth_m: NDArray[np.float32],
        color: NDArray[np.uint8],
        camera: PinholeCamera,
        T_map_camera: Pose,
    ) -> None:
        """Take the points of an image pair; a depth of 0 is none."""
        grid = np.zeros(depth_m.shape, bool)
        grid[:: self._step, :: self._step] = True
        rows, columns = np.nonzero(grid & (depth_m > 0))
        local = camera.ray_directions(columns, rows) * depth_m[rows, columns, None]
        points = (local @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]).astype(np.float32)
        cells = np.floor((points - self._low) / self._spacing_m).astype(np.int64)
        inside = np.flatnonzero(((cells >= 0) & (cells < self._extent)).all(axis=1))
        numbers = np.ravel_multi_index(tuple(cells[inside].T), tuple(self._extent))
        new = np.flatnonzero(~self._taken[numbers])
        numbers, first = np.unique(numbers[new], return_index=True)
        self._taken[numbers] = True
        kept = inside[new[first]]
        self._points.append(points[kept])
        self._colors.append(color[rows[kept], columns[kept]])

    @property
    def points(self) -> NDArray[np.float32]:
        """(N, 3) [m]."""
        return np.concatenate([np.zeros((0, 3), np.float32), *self._points])

    def content(self) -> Content:
        """Positions in four bytes, colours in one."""
        return Content([self.points, np.concatenate([np.zeros((0, 3), np.uint8), *self._colors])])
