"""Views of a coloured mesh from a camera's pose."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError
from meslam_core.se3 import Pose

BACKGROUND = 255
"""Grey of pixels that no surface covers."""


class MeshRenderer:
    """Casts rays at a mesh; build once, render many views.

    Args:
        mesh: triangles in the map's frame [m]; without vertex colours it is shaded by its slant.

    Raises:
        EvaluationError: when the mesh has no triangles.
    """

    def __init__(self, mesh: o3d.geometry.TriangleMesh) -> None:
        if not mesh.has_triangles():
            raise EvaluationError(
                "the mesh has no triangles, so there is nothing to look at; was anything mapped?"
            )
        self._caster = o3d.t.geometry.RaycastingScene()
        self._caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        self._triangles = np.asarray(mesh.triangles)
        self._colors = (
            np.asarray(mesh.vertex_colors, np.float32) if mesh.has_vertex_colors() else None
        )

    def render(
        self, camera: PinholeCamera, T_map_camera: Pose
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The view from a pose (4, 4).

        Returns:
            (H, W, 3) uint8 RGB, white where nothing is, and (H, W) float32 depth along the optical
            axis, 0 where nothing is [m].
        """
        directions = camera.pixel_directions().reshape(-1, 3)
        turned = directions @ T_map_camera[:3, :3].T.astype(np.float32)
        rays = np.empty((len(turned), 6), np.float32)
        rays[:, :3] = T_map_camera[:3, 3]
        rays[:, 3:] = turned
        hits = self._caster.cast_rays(o3d.core.Tensor.from_numpy(rays))
        # The directions have z = 1, so lengths along them are depths.
        distance = hits["t_hit"].numpy()
        seen = np.isfinite(distance)
        color = np.full((len(rays), 3), BACKGROUND, np.uint8)
        if self._colors is None:
            slant = np.abs(np.einsum("ij,ij->i", hits["primitive_normals"].numpy(), turned))
            slant /= np.linalg.norm(turned, axis=1)
            color[seen] = np.clip(60 + 170 * slant[seen, None], 0, 255).astype(np.uint8)
        else:
            corners = self._triangles[hits["primitive_ids"].numpy()[seen]]
            shares = hits["primitive_uvs"].numpy()[seen]
            weights = np.column_stack([1 - shares.sum(axis=1), shares])
            mixed = np.einsum("nk,nkc->nc", weights, self._colors[corners])
            color[seen] = np.clip(255 * mixed + 0.5, 0, 255).astype(np.uint8)
        size = (camera.height, camera.width)
        depth = np.where(seen, distance, 0).astype(np.float32)
        return color.reshape(*size, 3), depth.reshape(size)


def render_mesh(
    mesh: o3d.geometry.TriangleMesh, camera: PinholeCamera, T_map_camera: Pose
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """One view of a mesh; see `MeshRenderer.render`."""
    return MeshRenderer(mesh).render(camera, T_map_camera)
