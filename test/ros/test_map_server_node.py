from __future__ import annotations

import array
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from data.map_client import SCENE, WAIT_S, Code, fill, listed, model, publish, query, two_regions
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from meslam_core.map.stored_region import StoredRegion
from meslam_core.se3 import exp
from meslam_interfaces.msg import RegionIndex, RegionModel
from meslam_interfaces.srv import (
    ExportMap,
    GetMesh,
    GetOccupancyGrid,
    LoadMap,
    SaveMap,
)
from meslam_ros import topics
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.qos import STREAM, latched
from meslam_ros.transforms import StaticBroadcaster


@pytest.fixture(scope="module")
def regions() -> list[StoredRegion]:
    return two_regions()


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, str]:
    return {"export_folder": str(tmp_path / "exports"), "map_folder": str(tmp_path / "maps")}


@pytest.fixture
def server(start_node, folders):
    return start_node(MapServerNode, **folders)


def test_empty_map_says_so(server, client, tmp_path) -> None:
    assert listed(client).result == Code.SUCCESS
    assert len(listed(client).regions.regions) == 0
    calls = [
        (ExportMap, topics.EXPORT_MAP, ExportMap.Request(path="mesh.ply")),
        (GetMesh, topics.GET_MESH, None),
        (GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, None),
        (SaveMap, topics.SAVE_MAP, SaveMap.Request(name="map.meslam")),
    ]
    for kind, name, request in calls:
        answer = client.call(kind, name, request)
        assert answer.result == Code.EMPTY_MAP
        assert "nothing yet" in answer.message
    assert query(client, [[0, 0, 0]]).result == Code.EMPTY_MAP
    assert list(tmp_path.rglob("*.*")) == []


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_exported_mesh_opens_has_colour_and_is_true(
    server, client, regions, folders, suffix
) -> None:
    fill(client, regions[0])
    answer = client.call(
        ExportMap,
        topics.EXPORT_MAP,
        ExportMap.Request(path=f"room/mesh.{suffix}", resolution_m=0.05),
    )
    assert answer.result == Code.SUCCESS, answer.message
    path = Path(folders["export_folder"], "room", f"mesh.{suffix}").resolve()
    assert answer.path == str(path)
    assert answer.bytes == path.stat().st_size
    mesh = o3d.io.read_triangle_mesh(str(path))
    assert len(mesh.triangles) == answer.triangles
    if suffix == "ply":
        vertices = np.asarray(mesh.vertices)
        assert np.median(np.abs(SCENE.distance_m(vertices))) < 0.02
        ball = np.linalg.norm(vertices, axis=1) < 0.6
        red = np.asarray(mesh.vertex_colors)[ball].mean(axis=0)
        assert red[0] > 0.6 > 0.4 > red[1]


def test_mesh_in_the_answer_is_the_exported_one(server, client, regions, folders) -> None:
    fill(client, *regions)
    request = GetMesh.Request(resolution_m=0.06)
    answer = client.call(GetMesh, topics.GET_MESH, request)
    exported = client.call(
        ExportMap, topics.EXPORT_MAP, ExportMap.Request(path="mesh.ply", resolution_m=0.06)
    )
    assert answer.result == Code.SUCCESS
    vertices = np.frombuffer(answer.vertices, np.float32).reshape(-1, 3)
    triangles = np.frombuffer(answer.triangles, np.uint32).reshape(-1, 3)
    assert (len(vertices), len(triangles)) == (exported.vertices, exported.triangles)
    assert len(answer.colors) == 3 * len(vertices)
    assert triangles.max() < len(vertices)
    assert answer.header.frame_id == "map"


def test_box_and_regions_choose_a_part(server, client, regions) -> None:
    fill(client, *regions)
    request = GetMesh.Request(resolution_m=0.06, use_box=True)
    for name, value in (("box_min", -0.7), ("box_max", 0.7)):
        corner = getattr(request, name)
        corner.x = corner.y = corner.z = value
    ball = client.call(GetMesh, topics.GET_MESH, request)
    vertices = np.frombuffer(ball.vertices, np.float32).reshape(-1, 3)
    assert np.abs(np.linalg.norm(vertices, axis=1) - SCENE.radius_m).max() < 0.1
    one = GetMesh.Request(resolution_m=0.06, regions=[RegionIndex(index=[1, 0, 0])])
    whole = client.call(GetMesh, topics.GET_MESH, GetMesh.Request(resolution_m=0.06))
    part = client.call(GetMesh, topics.GET_MESH, one)
    assert 0 < len(part.triangles) < len(whole.triangles)


def test_occupancy_is_the_scenes(server, client, regions) -> None:
    fill(client, *regions)
    points = np.random.default_rng(0).uniform(-1.3, 1.3, (10_000, 3))
    answer = query(client, points, with_color=True, with_distance=True)
    assert answer.result == Code.SUCCESS
    state = np.array(answer.occupancy)
    truth = SCENE.distance_m(points)
    clear = np.abs(truth) > 0.03
    known = clear & (state != -1)
    assert known.mean() > 0.8
    assert ((state[known] == 100) == (truth[known] < 0)).mean() > 0.98
    probability = np.frombuffer(answer.probability, np.float32)
    assert np.isnan(probability[state == -1]).all()
    np.testing.assert_array_equal(probability[known] > 0.5, state[known] == 100)
    distance = np.frombuffer(answer.distances_m, np.float32)
    near = (np.abs(truth) < 0.06) & (state != -1)
    assert np.abs(distance[near] - truth[near]).mean() < 0.01
    colors = np.frombuffer(answer.colors, np.uint8).reshape(-1, 3)
    on_ball = near & (np.linalg.norm(points, axis=1) < 0.6)
    assert colors[on_ball, 0].mean() > 150 > 100 > colors[on_ball, 1].mean()


def test_space_nobody_saw_is_unknown(server, client, regions) -> None:
    fill(client, regions[0])
    answer = query(client, [[0, 0, 0], [9, 9, 9], [1.2, 0, 0]])
    assert list(answer.occupancy) == [-1, -1, 0]


def test_points_may_be_given_in_another_frame(server, client, regions) -> None:
    fill(client, regions[0])
    T_map_gripper = exp(np.array([0.3, -0.2, 0.1, 0.4, 0.2, -1.0]))
    kept = StaticBroadcaster(client.node, T_map_gripper, "map", "gripper")
    points = np.random.default_rng(2).uniform(-1.2, 1.2, (200, 3))
    in_map = query(client, points)
    moved = (points - T_map_gripper[:3, 3]) @ T_map_gripper[:3, :3]

    def same() -> bool:
        answer = query(client, moved, header=Header(frame_id="gripper"))
        agree = np.array(answer.occupancy) == np.array(in_map.occupancy)
        # The way there and back costs a rounding error at the surface.
        return answer.result == Code.SUCCESS and agree.mean() > 0.98

    assert client.spin_until(same, WAIT_S), kept


def test_grid_shows_the_ball_and_the_room(server, client, regions) -> None:
    fill(client, regions[0])
    request = GetOccupancyGrid.Request(
        resolution_m=0.05, use_heights=True, min_height_m=-0.1, max_height_m=0.1
    )
    answer = client.call(GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, request)
    assert answer.result == Code.SUCCESS, answer.message
    info = answer.grid.info
    cells = np.array(answer.grid.data).reshape(info.height, info.width)
    origin = info.origin.position

    def cell(x: float, y: float) -> int:
        return int(
            cells[int((y - origin.y) / info.resolution), int((x - origin.x) / info.resolution)]
        )

    assert cell(0.47, 0.0) == 100
    assert cell(0.9, 0.3) == 0
    assert cell(1.42, 0.0) == 100
    assert answer.grid.header.frame_id == "map"


def test_map_survives_saving_loading_and_a_restart(
    start_node, server, client, regions, folders
) -> None:
    fill(client, *regions)
    points = np.random.default_rng(1).uniform(-1.3, 1.3, (500, 3))
    before = query(client, points, with_color=True)
    saved = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="room.meslam"))
    assert saved.result == Code.SUCCESS, saved.message
    assert saved.regions == 2
    folder = Path(folders["map_folder"], "room.meslam")
    assert saved.bytes == sum(file.stat().st_size for file in folder.rglob("*"))
    server.trigger_deactivate()
    server.trigger_cleanup()
    assert server.start()
    assert query(client, points).result == Code.EMPTY_MAP or listed(client).regions.regions
    loaded = client.call(LoadMap, topics.LOAD_MAP, LoadMap.Request(name="room.meslam"))
    assert loaded.result == Code.SUCCESS, loaded.message
    assert (loaded.regions, loaded.map_id) == (2, "first")
    after = query(client, points, with_color=True)
    for field in ("occupancy", "probability", "colors"):
        np.testing.assert_array_equal(getattr(before, field), getattr(after, field))


def test_another_map_is_not_overwritten_by_mistake(server, client, regions) -> None:
    fill(client, regions[0])
    request = SaveMap.Request(name="map.meslam")
    assert client.call(SaveMap, topics.SAVE_MAP, request).result == Code.SUCCESS
    assert client.call(SaveMap, topics.SAVE_MAP, request).result == Code.SUCCESS
    publish(client, model(regions[0], "second"))
    assert client.spin_until(lambda: listed(client).regions.map_id == "second", WAIT_S)
    refused = client.call(SaveMap, topics.SAVE_MAP, request)
    assert refused.result == Code.INVALID_REQUEST
    assert "overwrite" in refused.message
    request.overwrite = True
    assert client.call(SaveMap, topics.SAVE_MAP, request).result == Code.SUCCESS


def test_damaged_map_is_named_and_the_rest_loads(server, client, regions, folders) -> None:
    fill(client, *regions)
    client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="map.meslam"))
    files = sorted(Path(folders["map_folder"], "map.meslam").glob("region_*"))
    files[0].write_bytes(files[0].read_bytes()[:-10])
    loaded = client.call(LoadMap, topics.LOAD_MAP, LoadMap.Request(name="map.meslam"))
    assert loaded.result == Code.SUCCESS
    assert loaded.regions == 1
    assert len(loaded.quarantined) == 1
    assert "damaged" in loaded.message
    files[1].write_bytes(b"nothing")
    broken = client.call(LoadMap, topics.LOAD_MAP, LoadMap.Request(name="map.meslam"))
    assert broken.result == Code.INVALID_DATA
    assert len(listed(client).regions.regions) == 1


def test_folder_that_cannot_be_written_is_named(start_node, client, regions, tmp_path) -> None:
    (tmp_path / "file").write_text("in the way")
    start_node(
        MapServerNode,
        export_folder=str(tmp_path / "file" / "x"),
        map_folder=str(tmp_path / "file" / "y"),
    )
    fill(client, regions[0])
    exported = client.call(
        ExportMap, topics.EXPORT_MAP, ExportMap.Request(path="mesh.ply", resolution_m=0.1)
    )
    saved = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="map"))
    for answer in (exported, saved):
        assert answer.result == Code.IO_ERROR
        assert str(tmp_path / "file") in answer.message


def damaged(kind: str, region: StoredRegion) -> RegionModel:
    message = model(region)
    if kind == "bytes":
        message.data[100] ^= 1
    elif kind == "truncated":
        message.data = message.data[:-20]
    elif kind == "format":
        message.format = "meslam-region/99"
    elif kind == "empty":
        message.data = array.array("B")
    elif kind == "index":
        message.index = [3, 3, 3]
    elif kind == "version":
        message.version += 1
    elif kind == "box":
        message.pose.position.x += 1.0
    return message


@pytest.mark.parametrize(
    "kind", ["bytes", "truncated", "format", "empty", "index", "version", "box"]
)
def test_damaged_models_are_refused_and_counted(server, client, regions, capfd, kind) -> None:
    reports: list[DiagnosticStatus] = []
    client.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, lambda m: reports.extend(m.status), STREAM
    )
    fill(client, regions[0])
    publish(client, damaged(kind, replace(regions[1], version=5)))
    assert client.spin_until(lambda: any("refused" in report.message for report in reports), WAIT_S)
    assert "region model refused: region [" in capfd.readouterr().err
    assert len(listed(client).regions.regions) == 1
    publish(client, model(replace(regions[1], version=6)))
    assert client.spin_until(lambda: len(listed(client).regions.regions) == 2, WAIT_S)


def test_late_server_gets_every_region_once(start_node, client, regions, folders) -> None:
    publish(client, *(model(region) for region in regions))
    start_node(MapServerNode, **folders)
    assert client.spin_until(lambda: len(listed(client).regions.regions) == 2, WAIT_S)


def test_topics_show_the_map_to_late_viewers(start_node, client, regions, folders) -> None:
    start_node(MapServerNode, mesh_topic_resolution_m=0.1, mesh_topic_period_s=0.2, **folders)
    fill(client, *regions)
    meshes: dict[int, Marker] = {}
    clouds: list[PointCloud2] = []
    grids: list[OccupancyGrid] = []
    subscribe = client.node.create_subscription
    subscribe(Marker, topics.MESH, lambda m: meshes.__setitem__(m.id, m), latched(10))
    subscribe(PointCloud2, topics.MAP_POINTS, clouds.append, latched())
    subscribe(OccupancyGrid, topics.OCCUPANCY_GRID, grids.append, latched())
    added = {Marker.ADD}
    assert client.spin_until(
        lambda: (
            {m.action for m in meshes.values()} == added
            and len(meshes) == 2
            and bool(clouds)
            and bool(grids)
        ),
        WAIT_S,
    )
    for mesh in meshes.values():
        assert mesh.type == Marker.TRIANGLE_LIST
        assert len(mesh.points) == len(mesh.colors) > 0
        assert len(mesh.points) % 3 == 0
        assert mesh.header.frame_id == "map"
    cloud = clouds[-1]
    rows = np.frombuffer(cloud.data, [("position", "<f4", 3), ("rgb", "<u4")])
    assert len(rows) == cloud.width > 100
    assert np.median(np.abs(SCENE.distance_m(rows["position"]))) < 0.02
    assert set(np.unique(grids[-1].data)) == {-1, 0, 100}


def test_a_correction_that_moves_a_region_reaches_the_topics(
    start_node, client, regions, folders
) -> None:
    start_node(MapServerNode, mesh_topic_resolution_m=0.1, mesh_topic_period_s=0.2, **folders)
    fill(client, *regions)
    meshes: dict[int, Marker] = {}
    grids: list[OccupancyGrid] = []
    clouds: list[PointCloud2] = []
    subscribe = client.node.create_subscription
    subscribe(Marker, topics.MESH, lambda m: meshes.__setitem__(m.id, m), latched(10))
    subscribe(OccupancyGrid, topics.OCCUPANCY_GRID, grids.append, latched())
    subscribe(PointCloud2, topics.MAP_POINTS, clouds.append, latched())
    assert client.spin_until(lambda: len(meshes) == 2 and bool(grids) and bool(clouds), WAIT_S)
    lowest = {number: _lowest_x(mesh) for number, mesh in meshes.items()}
    before = grids[-1].info
    shift = np.eye(4)
    shift[0, 3] = -1.0
    moved = [
        replace(region, T_map_region=shift @ region.T_map_region, version=region.version + 1)
        for region in regions
    ]
    publish(client, *(model(region) for region in moved))

    def followed() -> bool:
        shifts = [_lowest_x(meshes[number]) - lowest[number] for number in lowest]
        corner = grids[-1].info.origin.position.x - before.origin.position.x
        cloud = np.frombuffer(clouds[-1].data, [("position", "<f4", 3), ("rgb", "<u4")])
        ball = SCENE.distance_m(cloud["position"] + np.array([1.0, 0.0, 0.0]))
        return bool(
            np.allclose(shifts, -1.0, atol=0.05)
            and abs(corner + 1.0) < 0.051
            and np.median(np.abs(ball)) < 0.02
        )

    assert client.spin_until(followed, WAIT_S)
    assert np.array_equal(query(client, [[-1.0, 0.0, 0.0], [0.2, 0.0, 0.0]]).occupancy, [-1, 0])


def _lowest_x(mesh: Marker) -> float:
    return min(point.x for point in mesh.points)
