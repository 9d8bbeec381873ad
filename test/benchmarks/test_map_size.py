"""The benchmark of map sizes: the classic maps on exact views, and what is said of the figures."""

from __future__ import annotations

import json

import map_size
import numpy as np
import open3d as o3d
import pytest
from classic_maps import Content, PointCloud, TsdfVolume, mesh_content
from data.textured_room import frame_at, path
from map_size_figures import Row, table_of, verdicts, write_results
from rich.console import Console

from meslam_core.camera import PinholeCamera

CAMERA = PinholeCamera(width=160, height=120, fx=130.0, fy=131.0, cx=79.0, cy=60.5)
BOUNDS = np.array([[-4.0, -4.0, -4.0], [4.0, 4.0, 4.0]])
WALL_M = 2.0


def wall_view() -> tuple[np.ndarray, np.ndarray, PinholeCamera, np.ndarray]:
    """Depth, colour, camera and pose of a grey wall across the optical axis."""
    depth_m = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    return depth_m, np.full((*depth_m.shape, 3), 90, np.uint8), CAMERA, np.eye(4)


def wall() -> o3d.geometry.TriangleMesh:
    corners = [[-9.0, -9.0, WALL_M], [9.0, -9.0, WALL_M], [9.0, 9.0, WALL_M], [-9.0, 9.0, WALL_M]]
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(corners), o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]])
    )


def volume_of_wall(views: int) -> TsdfVolume:
    volume = TsdfVolume(0.02, 0.08, 4.0)
    for _ in range(views):
        volume.add(*wall_view())
    return volume


def test_the_volume_shows_the_wall_in_its_colour():
    mesh = volume_of_wall(4).mesh()
    vertices = np.asarray(mesh.vertices)
    np.testing.assert_allclose(vertices[:, 2], WALL_M, atol=1e-3)
    assert np.ptp(vertices[:, 0]) == pytest.approx(WALL_M * 159 / 130, abs=0.05)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), 90 / 255, atol=0.01)


def test_a_surface_seen_once_is_noise_but_takes_room():
    volume = volume_of_wall(1)
    assert not volume.mesh().has_triangles()
    assert volume.content().bytes > 0


def test_the_volume_is_all_voxels_of_its_blocks():
    arrays = volume_of_wall(1).content().arrays
    blocks = len(arrays[0])
    # A place of 12 bytes, and 512 voxels of a distance, a weight and three colours.
    assert Content(arrays).bytes == blocks * (12 + 512 * (4 + 2 + 6))
    faces_m = (0.16 * np.ptp(arrays[0], axis=0)).tolist()
    assert faces_m[0] == pytest.approx(WALL_M * 160 / 130, abs=0.33)


def test_frames_from_other_places_meet():
    volume = TsdfVolume(0.02, 0.08, 6.0)
    for number, pose in enumerate(path(6, 0.03, 2.0)):
        frame = frame_at(pose, number, CAMERA)
        volume.add(frame.depth_m, frame.color, frame.camera, pose)
    frame = frame_at(path(6, 0.03, 2.0)[3], 3, CAMERA)
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(volume.mesh()))
    rows, columns = np.nonzero(frame.depth_m[20:100, 20:140] > 0)
    pose = path(6, 0.03, 2.0)[3]
    directions = CAMERA.ray_directions(columns + 20, rows + 20) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    hit = caster.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    error = np.abs(hit - frame.depth_m[rows + 20, columns + 20])
    assert np.median(error) < 0.003


def test_a_mesh_takes_its_arrays():
    mesh = volume_of_wall(4).mesh()
    content = mesh_content(mesh)
    assert content.bytes == 15 * len(mesh.vertices) + 12 * len(mesh.triangles)
    assert 0 < content.deflated_bytes < 0.6 * content.bytes


def test_a_cube_holds_one_point_and_no_more_come_from_the_same_view():
    cloud = PointCloud(BOUNDS, 0.05, 1)
    cloud.add(*wall_view())
    count = len(cloud.points)
    cells = np.floor(cloud.points / 0.05).astype(int)
    assert len(np.unique(cells, axis=0)) == count
    np.testing.assert_allclose(cloud.points[:, 2], WALL_M)
    cloud.add(*wall_view())
    assert len(cloud.points) == count
    assert cloud.content().bytes == 15 * count


def test_a_cloud_leaves_out_holes_and_what_is_beyond_its_bounds():
    depth_m, color, camera, pose = wall_view()
    depth_m[:, :80], depth_m[:60, 80:] = 0.0, 9.0
    cloud = PointCloud(BOUNDS, 0.05, 1)
    cloud.add(depth_m, color, camera, pose)
    assert (cloud.points[:, 0] >= 0.0).all()
    assert (cloud.points[:, 1] >= -0.05).all()
    np.testing.assert_allclose(cloud.points[:, 2], WALL_M)


def test_the_error_of_a_cloud_is_its_distance():
    cloud = PointCloud(BOUNDS, 0.01, 1)
    cloud.add(*wall_view())
    observed = np.concatenate([cloud.points, np.add(cloud.points, (0.0, 9.0, 0.0))])
    error = map_size.cloud_error(cloud.points - (0.0, 0.0, 0.02), wall(), observed)
    assert error["accuracy_median_m"] == pytest.approx(0.02, abs=1e-5)
    assert error["completion_ratio"] == pytest.approx(0.5)


def row(method: str, seconds: float, size: int, ratio: float, accuracy_m: float) -> Row:
    error = {"accuracy_median_m": accuracy_m, "completion_ratio": ratio}
    error |= {"accuracy_mean_m": accuracy_m, "completion_median_m": accuracy_m}
    return Row(method, seconds, size, size, error, 0.01, 2)


GOOD = [
    row("ours, fp32", 30.0, 400_000, 0.95, 0.01),
    row("ours, int8", 30.0, 100_000, 0.95, 0.0101),
    row("ours, fp32", 60.0, 400_000, 0.95, 0.01),
    row("ours, int8", 60.0, 101_000, 0.94, 0.01),
]


def test_a_small_and_good_map_meets_every_target():
    assert len(verdicts(GOOD)) == 5
    assert not [line for line in verdicts(GOOD) if "MISSES" in line]


@pytest.mark.parametrize(
    ("number", "worst"),
    [
        (0, row("ours, int8", 60.0, 201_000, 0.94, 0.01)),
        (4, row("ours, int8", 60.0, 103_000, 0.94, 0.01)),
        (1, row("ours, int8", 60.0, 101_000, 0.89, 0.01)),
        (2, row("ours, int8", 60.0, 101_000, 0.94, 0.016)),
        (3, row("ours, int8", 60.0, 101_000, 0.92, 0.01)),
    ],
)
def test_the_worst_duration_decides(number, worst):
    assert "MISSES" in verdicts([*GOOD[:3], worst])[number]


def test_one_duration_says_nothing_about_growth():
    assert len(verdicts(GOOD[:2])) == 4
    assert not [line for line in verdicts(GOOD[:2]) if "differ" in line]


def test_finished_parts_come_back_as_they_were(tmp_path):
    kept = map_size.keep(tmp_path / "part" / "ours.json", GOOD)
    assert map_size.kept(tmp_path / "part" / "ours.json") == kept == GOOD
    assert map_size.kept(tmp_path / "other.json") is None


def test_results_are_a_table_json_and_a_picture(tmp_path):
    rows = [*GOOD, Row("TSDF mesh, 1 cm", 30.0, 50_000_000, 9_000_000, GOOD[0].error)]
    head = {"command": "python x.py", "machine": map_size.machine(), "note": ""}
    write_results(rows, head, tmp_path / "map_size", Console(quiet=True))
    text = (tmp_path / "map_size.txt").read_text()
    assert "python x.py" in text
    assert "true poses" in text
    assert len(json.loads((tmp_path / "map_size.json").read_text())["rows"]) == len(rows)
    assert (tmp_path / "map_size.png").read_bytes().startswith(b"\x89PNG")
    assert table_of(rows).row_count == len(rows)
