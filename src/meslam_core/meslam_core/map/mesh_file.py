"""Meshes to files: PLY, glTF binary, and OBJ through Open3D."""

from __future__ import annotations

import json
import os
import struct
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from meslam_core.errors import OutputError
from meslam_core.map.files import cannot_write, produce_atomically
from meslam_core.map.triangle_mesh import TriangleMesh
from meslam_core.threads import open3d as o3d

if TYPE_CHECKING:
    from open3d.geometry import TriangleMesh as Open3dMesh

FORMATS = (".ply", ".glb", ".obj")

_PLY_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
_SRGB = np.arange(256) / 255.0
_LINEAR = np.rint(
    65535.0 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
).astype("<u2")
"""What linear light the 256 values of sRGB stand for (IEC 61966-2-1), as 16 bits."""
_PLY_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_mesh(mesh: TriangleMesh, path: str | Path) -> None:
    """Write a mesh in the format of the name's ending; the file is whole or not there.

    Args:
        mesh: to write.
        path: ending in one of FORMATS; all hold normals and colours, PLY and GLB are binary.

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
        elif suffix == ".glb":
            produce_atomically(path, lambda file: write_glb(mesh, file))
        else:
            _write_obj(mesh, path)
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


def write_glb(mesh: TriangleMesh, file: BinaryIO) -> None:
    """One mesh in glTF 2.0's binary container; its node turns z up into glTF's y up.

    Colours are linear there, and of 16 bits so that dark ones stay apart; they hold the light of
    the scene, so the material is unlit (KHR_materials_unlit).
    """
    colors = np.full((len(mesh.colors), 4), 65535, "<u2")
    colors[:, :3] = _LINEAR[mesh.colors]
    parts = [mesh.triangles.astype("<u4"), mesh.vertices, mesh.normals, colors]
    views, accessors, start = [], [], 0
    for part, component, shape in zip(
        parts, (5125, 5126, 5126, 5123), ("SCALAR", "VEC3", "VEC3", "VEC4"), strict=True
    ):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": part.nbytes})
        count = part.size if shape == "SCALAR" else len(part)
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": count}
            | {"type": shape, "normalized": component == 5123}
        )
        start += part.nbytes
    accessors[1] |= {
        "min": mesh.vertices.min(axis=0).tolist(),
        "max": mesh.vertices.max(axis=0).tolist(),
    }
    attributes = {"POSITION": 1, "NORMAL": 2, "COLOR_0": 3}
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0},
        "extensions": {"KHR_materials_unlit": {}},
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "MeSLAM"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [material],
        "extensionsUsed": ["KHR_materials_unlit"],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + start))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", start, b"BIN\0"))
    for part in parts:
        file.write(part.tobytes())


def _write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Through a folder of its own, since Open3D writes in place."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mesh-") as folder:
        temporary = Path(folder) / path.name
        if not o3d.io.write_triangle_mesh(temporary, to_open3d(mesh)):
            raise OutputError(f"{path}: Open3D could not write it; write .ply instead")
        os.replace(temporary, path)
