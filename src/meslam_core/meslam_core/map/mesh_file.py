"""Meshes to files: PLY here, other formats through Open3D."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import open3d as o3d

from meslam_core.errors import OutputError
from meslam_core.map.files import cannot_write, produce_atomically
from meslam_core.map.mesh import TriangleMesh

if TYPE_CHECKING:
    from open3d.geometry import TriangleMesh as Open3dMesh

OPEN3D_FORMATS = (".obj", ".glb", ".gltf", ".stl", ".off")
FORMATS = (".ply", *OPEN3D_FORMATS)

_PLY_VERTEX = np.dtype(
    [("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)]
)
_PLY_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_mesh(mesh: TriangleMesh, path: str | Path) -> None:
    """Write a mesh in the format of the name's ending; the file is whole or not there.

    Args:
        mesh: to write.
        path: ending in one of FORMATS; PLY is binary with normals and colours.

    Raises:
        OutputError: for an unknown format, an empty mesh, or a place that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise OutputError(f"{path}: meshes are written as {', '.join(FORMATS)}; choose one of them")
    if not len(mesh.triangles):
        raise OutputError(f"{path} is not written: the mesh is empty, nothing was observed there")
    try:
        if suffix == ".ply":
            produce_atomically(path, lambda file: _write_ply(mesh, file))
        else:
            _write_open3d(mesh, path, suffix)
    except OSError as error:
        raise cannot_write(path, error) from error


def to_open3d(mesh: TriangleMesh) -> Open3dMesh:
    """The mesh as Open3D's (legacy) TriangleMesh, float64 inside."""
    result = o3d.geometry.TriangleMesh()
    result.vertices = o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64))
    result.triangles = o3d.utility.Vector3iVector(mesh.triangles)
    result.vertex_normals = o3d.utility.Vector3dVector(mesh.normals.astype(np.float64))
    result.vertex_colors = o3d.utility.Vector3dVector(mesh.colors.astype(np.float64) / 255.0)
    return result


def _write_ply(mesh: TriangleMesh, file: BinaryIO) -> None:
    axes = ("x", "y", "z")
    lines = ["ply", "format binary_little_endian 1.0", "comment MeSLAM, map frame, metres"]
    lines += [f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in axes]
    lines += [f"property float n{name}" for name in axes]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += [f"element face {len(mesh.triangles)}"]
    lines += ["property list uchar int vertex_indices", "end_header", ""]
    file.write("\n".join(lines).encode())
    vertices = np.empty(len(mesh.vertices), _PLY_VERTEX)
    vertices["position"], vertices["normal"] = mesh.vertices, mesh.normals
    vertices["color"] = mesh.colors
    file.write(vertices.tobytes())
    faces = np.empty(len(mesh.triangles), _PLY_FACE)
    faces["count"], faces["vertices"] = 3, mesh.triangles
    file.write(faces.tobytes())


def _write_open3d(mesh: TriangleMesh, path: Path, suffix: str) -> None:
    """Through a folder of its own, since some formats write several files."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mesh-") as folder:
        temporary = Path(folder) / path.name
        if not o3d.io.write_triangle_mesh(temporary.as_posix(), to_open3d(mesh)):
            raise OutputError(f"{path}: Open3D could not write {suffix}; write .ply instead")
        for produced in sorted(Path(folder).iterdir()):
            os.replace(produced, path.parent / produced.name)
