from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from data.analytic_scene import SphereInRoom
from scipy.spatial import cKDTree

from meslam_core.errors import MapError, OutputError
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import FORMATS, to_open3d, write_mesh
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.stored_region import StoredRegion
from meslam_core.map.triangle_mesh import TriangleMesh, without_shards

RESOLUTION_M = 0.04


@pytest.fixture(scope="module")
def mesh(neural_map: NeuralMap) -> TriangleMesh:
    return extract_mesh(neural_map, RESOLUTION_M)


def open_edges(mesh: TriangleMesh) -> int:
    """Edges with a triangle on one side only."""
    a, b, c = mesh.triangles.T
    edges = np.sort(np.stack([[a, b], [b, c], [c, a]]).transpose(0, 2, 1).reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


def tetrahedron(size: float, center: float) -> TriangleMesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) * size + center
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return TriangleMesh(corners, faces, corners, np.zeros((4, 3), np.uint8))


def joined(meshes: list[TriangleMesh]) -> TriangleMesh:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])[:-1]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.triangles + s for m, s in zip(meshes, starts, strict=True)]).astype("i4"),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.colors for mesh in meshes]),
    )


def test_the_surface_is_where_it_was(mesh: TriangleMesh, scene: SphereInRoom) -> None:
    error = np.abs(scene.distance_m(mesh.vertices.astype(float)))
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.95) < 0.010
    area = 6 * (2 * scene.wall_m) ** 2 + 4 * np.pi * scene.radius_m**2
    assert mesh.triangle_areas_m2.sum() == pytest.approx(area, rel=0.02)


def test_the_surface_is_closed_across_tiles(mesh: TriangleMesh) -> None:
    assert open_edges(mesh) == 0
    assert len(np.unique(mesh.triangles)) == len(mesh.vertices)


def test_triangles_face_free_space(mesh: TriangleMesh, scene: SphereInRoom) -> None:
    corners = mesh.vertices.astype(float)[mesh.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    ahead = scene.distance_m(corners.mean(axis=1) + 0.02 * facing)
    assert (ahead > 0.0).mean() > 0.995
    agreement = (facing * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1)
    assert (agreement > 0.5).mean() > 0.97
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-3)


def test_colors_are_the_scene_s(mesh: TriangleMesh, scene: SphereInRoom) -> None:
    truth = scene.color(mesh.vertices.astype(float)) * 255.0
    assert np.median(np.abs(mesh.colors - truth)) < 6.0


def test_finer_meshes_have_more_triangles(neural_map: NeuralMap, mesh: TriangleMesh) -> None:
    box = (np.full(3, -0.6), np.full(3, 0.6))
    fine = extract_mesh(neural_map, RESOLUTION_M / 2, box=box)
    coarse = extract_mesh(neural_map, RESOLUTION_M, box=box)
    assert len(fine.triangles) > 3 * len(coarse.triangles)


def test_a_box_cuts_the_same_mesh(neural_map: NeuralMap, mesh: TriangleMesh) -> None:
    low, high = np.array([-0.55, -0.55, 0.0]), np.array([0.55, 0.55, 0.8])
    part = extract_mesh(neural_map, RESOLUTION_M, box=(low, high))
    assert ((part.vertices >= low) & (part.vertices <= high)).all()
    assert cKDTree(mesh.vertices).query(part.vertices)[0].max() < 1e-4
    half_sphere = 2 * np.pi * 0.25
    assert part.triangle_areas_m2.sum() == pytest.approx(half_sphere, rel=0.12)


def test_a_region_gives_what_it_saw(region: StoredRegion, neighbour: StoredRegion) -> None:
    both = NeuralMap([region, neighbour])
    part = extract_mesh(both, 0.05, regions=[(1, 0, 0)])
    # The neighbour's mask begins 2.4 m before its centre at 2.486 m.
    assert part.vertices[:, 0].min() > 0.0
    assert len(part.triangles) < 0.8 * len(extract_mesh(both, 0.05).triangles)
    with pytest.raises(MapError, match="no region"):
        extract_mesh(both, 0.05, regions=[(7, 7, 7)])


def test_two_regions_make_one_closed_surface(
    region: StoredRegion, neighbour: StoredRegion, scene: SphereInRoom
) -> None:
    mesh = extract_mesh(NeuralMap([region, neighbour]), 0.05)
    assert open_edges(mesh) == 0
    assert np.median(np.abs(scene.distance_m(mesh.vertices.astype(float)))) < 0.002


def test_the_same_mesh_every_time(neural_map: NeuralMap, mesh: TriangleMesh) -> None:
    again = extract_mesh(neural_map, RESOLUTION_M)
    assert np.array_equal(again.vertices, mesh.vertices)
    assert np.array_equal(again.triangles, mesh.triangles)


def test_progress_ends_complete(neural_map: NeuralMap) -> None:
    calls: list[tuple[int, int]] = []
    extract_mesh(neural_map, 0.08, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1][0] == calls[-1][1] == len(calls)


def test_coarse_cubes(neural_map: NeuralMap, scene: SphereInRoom) -> None:
    mesh = extract_mesh(neural_map, 0.07)
    assert np.median(np.abs(scene.distance_m(mesh.vertices.astype(float)))) < 0.005


@pytest.mark.parametrize("resolution", [0.0, -1.0, 5.0, float("nan")])
def test_resolutions_without_sense(neural_map: NeuralMap, resolution: float) -> None:
    with pytest.raises(MapError, match="resolution"):
        extract_mesh(neural_map, resolution)


def test_an_empty_box_and_an_empty_place(neural_map: NeuralMap) -> None:
    with pytest.raises(MapError, match="empty"):
        extract_mesh(neural_map, 0.05, box=(np.ones(3), np.zeros(3)))
    nowhere = extract_mesh(neural_map, 0.05, box=(np.full(3, 8.0), np.full(3, 9.0)))
    assert len(nowhere.triangles) == 0


def test_small_pieces_are_dropped() -> None:
    mesh = joined([tetrahedron(1.0, 0.0), tetrahedron(0.05, 3.0), tetrahedron(0.5, 5.0)])
    kept = without_shards(mesh, 0.01)
    assert len(kept.triangles) == 8
    assert len(kept.vertices) == 8
    assert kept.triangle_areas_m2.sum() == pytest.approx(
        mesh.triangle_areas_m2[[0, 1, 2, 3, 8, 9, 10, 11]].sum()
    )
    assert without_shards(mesh, 0.0) is mesh


@pytest.mark.parametrize("suffix", FORMATS)
def test_files_open_in_open3d(tmp_path: Path, mesh: TriangleMesh, suffix: str) -> None:
    path = tmp_path / f"room{suffix}"
    write_mesh(mesh, path)
    read = o3d.io.read_triangle_mesh(str(path))
    assert np.asarray(read.triangles).shape == mesh.triangles.shape
    # Readers reorder vertices, and turn glTF's axes (y up).
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if suffix == ".glb" else np.eye(3)
    distances, number = cKDTree(mesh.vertices).query(np.asarray(read.vertices) @ turn.T)
    assert distances.max() < 2e-5
    assert len(np.unique(number)) == len(mesh.vertices)
    colors = np.asarray(read.vertex_colors)
    if suffix == ".glb":
        # glTF's are linear.
        colors = 1.055 * np.maximum(colors, 0.0031308) ** (1 / 2.4) - 0.055
    assert np.abs(colors * 255.0 - mesh.colors[number]).max() < 1.0
    assert np.allclose(np.asarray(read.vertex_normals) @ turn.T, mesh.normals[number], atol=1e-4)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_to_open3d(mesh: TriangleMesh) -> None:
    legacy = to_open3d(mesh)
    assert np.allclose(np.asarray(legacy.vertices), mesh.vertices)
    assert legacy.has_vertex_colors()
    assert legacy.is_edge_manifold()


def test_meshes_that_cannot_be_written(tmp_path: Path, mesh: TriangleMesh) -> None:
    with pytest.raises(OutputError, match=r"\.ply"):
        write_mesh(mesh, tmp_path / "room.docx")
    nothing = mesh.selected(np.zeros(len(mesh.triangles), bool))
    with pytest.raises(OutputError, match="empty"):
        write_mesh(nothing, tmp_path / "room.ply")
    for suffix in FORMATS:
        with pytest.raises(OutputError, match="cannot be written"):
            write_mesh(mesh, tmp_path / "nowhere" / f"room{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_keeps_the_old_file(
    tmp_path: Path, mesh: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "room.ply"
    path.write_bytes(b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match="No space"):
        write_mesh(mesh, path)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["room.ply"]
