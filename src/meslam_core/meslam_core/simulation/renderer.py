"""Exact views of a scene: colour, depth and incidence of every pixel."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.se3 import Pose
from meslam_core.simulation.atlas import Atlas, lay_out
from meslam_core.simulation.lighting import bake
from meslam_core.simulation.scene import Scene

# Without the kernel numpy and cast rays give the same views, more slowly.
_kernel: Any = None
with contextlib.suppress(ImportError):
    from meslam_core.field import _kernel

EDGE_SAMPLES = np.array([(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)])
"""Offsets of the extra rays of a pixel on an edge [px], a rotated grid."""


SHADE_BLOCK = 1 << 14


@dataclass(frozen=True)
class View:
    """What an ideal camera sees.

    Attributes:
        color: (H, W, 3) float32 in [0, 255].
        depth_m: (H, W) float32 along the optical axis, 0 where nothing is [m].
        incidence: (H, W) float32 cosine between ray and surface normal.
    """

    color: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    incidence: NDArray[np.float32]


@dataclass(frozen=True)
class _Hits:
    """Where N rays end: distance in ray lengths, triangle, place in it, cosine."""

    distance: NDArray[np.float32]
    triangle: NDArray[np.uint32]
    shares: NDArray[np.float32]
    incidence: NDArray[np.float32]


class Renderer:
    """Renders a scene: which triangles are seen where, and their textures.

    Args:
        scene: what to render.
        texel_scale: texels this much longer than the scene asks for, for small cameras.
        seed: of everything random in the textures.
    """

    def __init__(self, scene: Scene, texel_scale: float = 1.0, seed: int = 0) -> None:
        self.surface = scene_surface(scene)
        self._corners = np.asarray(self.surface.vertices)[np.asarray(self.surface.triangles)]
        self._caster = o3d.t.geometry.RaycastingScene()
        self._caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(self.surface))
        layout = lay_out(scene.patches, texel_scale)
        texels, patch_of, texel_m = [], [], []
        for index, patch in enumerate(scene.patches):
            count = len(patch.triangles)
            texels.append(layout.texels(index, patch, patch.coordinates)[patch.triangles])
            patch_of.append(np.full(count, index, np.int32))
            texel_m.append(np.full(count, patch.texel_m * texel_scale, np.float32))
        corners = np.concatenate(texels).astype(np.float32)
        edges = corners[:, 1:] - corners[:, :1]
        # Rows: atlas position of a triangle's first corner, its two edges, its texels' length.
        self._texels = np.concatenate(
            [corners[:, 0], edges[:, 0], edges[:, 1], np.concatenate(texel_m)[:, None]], axis=1
        )
        self._patch_of = np.concatenate(patch_of)
        self._atlas = Atlas(scene.patches, layout, bake(scene, self._caster), seed)

    def render(self, camera: PinholeCamera, T_map_camera: Pose) -> View:
        """The view of a camera at a pose (4, 4) in the scene's frame.

        Colour is filtered over each pixel's footprint and, where a pixel holds an edge, averaged
        over several rays; depth is that of the pixel's centre.
        """
        hits = self._seen(camera, T_map_camera)
        color = self._shade(hits, camera)
        size = (camera.height, camera.width)
        seen = np.isfinite(hits.distance)
        # Directions have z = 1, so ray lengths are depths.
        depth = np.where(seen, hits.distance, 0).astype(np.float32).reshape(size)
        patches = np.where(seen, self._patch_of.take(hits.triangle, mode="clip"), -1)
        rows, columns = np.nonzero(_edges(patches.reshape(size)))
        if len(rows):
            u, v = (
                (pixels[:, None] + EDGE_SAMPLES[:, axis]).ravel()
                for axis, pixels in enumerate((columns, rows))
            )
            rays = _with_lengths(camera.ray_directions(u, v))
            extra = self._shade(self._cast(*rays, T_map_camera), camera)
            mean = extra.reshape(len(rows), len(EDGE_SAMPLES), 3).mean(axis=1)
            color[rows * camera.width + columns] = mean
        return View(color.reshape(*size, 3), depth, hits.incidence.reshape(size))

    def _seen(self, camera: PinholeCamera, T_map_camera: Pose) -> _Hits:
        """What the pixels' centres see, row by row."""
        if _kernel is None:
            return self._cast(*_image_rays(camera), T_map_camera)
        corners = (self._corners - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
        intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        return _Hits(
            *_kernel.seen_triangles(corners, width=camera.width, height=camera.height, **intrinsics)
        )

    def _cast(
        self, directions: NDArray[np.float32], lengths: NDArray[np.float32], T_map_camera: Pose
    ) -> _Hits:
        """Cast rays of camera-frame directions (N, 3) and their lengths (N,) from the camera."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = T_map_camera[:3, 3]
        turned = rays[:, 3:]
        np.matmul(directions, T_map_camera[:3, :3].T.astype(np.float32), out=turned)
        answer = self._caster.cast_rays(o3d.core.Tensor.from_numpy(rays))
        normals = answer["primitive_normals"].numpy()
        cosine = np.abs(np.einsum("ij,ij->i", normals, turned))
        cosine /= lengths
        return _Hits(
            distance=answer["t_hit"].numpy(),
            triangle=answer["primitive_ids"].numpy(),
            shares=answer["primitive_uvs"].numpy(),
            incidence=cosine,
        )

    def _shade(self, hits: _Hits, camera: PinholeCamera) -> NDArray[np.float32]:
        """Colours (N, 3) in [0, 255] at the rays' ends, black where there is none."""
        if _kernel is not None:
            return np.asarray(
                _kernel.shade(
                    self._atlas.image,
                    self._atlas.levels,
                    self._texels,
                    distance=hits.distance,
                    triangle=hits.triangle,
                    shares=hits.shares,
                    cosine=hits.incidence,
                    focal_px=camera.fx,
                )
            )
        color = np.empty((len(hits.distance), 3), np.float32)
        # In blocks, because the intermediate arrays of a whole image leave the cache.
        for first in range(0, len(color), SHADE_BLOCK):
            block = slice(first, first + SHADE_BLOCK)
            distance, triangle = hits.distance[block], hits.triangle[block]
            seen = np.isfinite(distance)
            triangle = np.where(seen, triangle, 0)
            shares, table = hits.shares[block], self._texels[triangle].T
            x = table[0] + shares[:, 0] * table[2] + shares[:, 1] * table[4]
            y = table[1] + shares[:, 0] * table[3] + shares[:, 1] * table[5]
            # Between the footprint's short and long axis: neither shimmering nor washed out.
            slant = np.sqrt(np.maximum(hits.incidence[block], np.float32(0.05)))
            texel_px = np.float32(camera.fx) * table[6] * slant
            footprint = np.where(seen, distance, 1) / texel_px
            color[block] = np.where(seen[:, None], self._atlas.lookup(x, y, footprint), 0)
        return color


@lru_cache(maxsize=2)
def _image_rays(camera: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Directions (N, 3) of all pixels row by row, and their lengths (N,)."""
    return _with_lengths(camera.pixel_directions().reshape(-1, 3))


def _with_lengths(
    directions: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return directions, np.sqrt(np.einsum("ij,ij->i", directions, directions))


def scene_surface(scene: Scene) -> o3d.geometry.TriangleMesh:
    """All patches as one mesh whose triangles keep the patches' order."""
    vertices, triangles, first = [], [], 0
    for patch in scene.patches:
        vertices.append(patch.vertices)
        triangles.append(patch.triangles + first)
        first += len(patch.vertices)
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.concatenate(vertices)),
        o3d.utility.Vector3iVector(np.concatenate(triangles).astype(np.int32)),
    )


def _edges(patches: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Pixels (H, W) with a neighbour on another patch."""
    result = np.zeros(patches.shape, bool)
    beside = patches[:, 1:] != patches[:, :-1]
    above = patches[1:] != patches[:-1]
    result[:, 1:] |= beside
    result[:, :-1] |= beside
    result[1:] |= above
    result[:-1] |= above
    return result
