"""Stored maps: the map server alone answers from one, and gives it to a running system."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from data.map_client import SCENE, WAIT_S, Code, fill, listed, query, two_regions
from data.room_camera import ANSWER_S, FAST, POSES, Camera
from std_srvs.srv import Trigger

from meslam_core.se3 import inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import (
    GetMesh,
    GetOccupancyGrid,
    ListRegions,
    LoadMap,
    SaveMap,
)
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, to_pose
from meslam_ros.map_server_node import MapServerNode
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.tracking_node import TrackingNode


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, str]:
    return {"export_folder": str(tmp_path / "exports"), "map_folder": str(tmp_path / "maps")}


def save(client: MeslamClient, name: str = "room.meslam") -> None:
    answer = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name=name))
    assert answer.result == Code.SUCCESS, answer.message


def everything(client: MeslamClient) -> dict[str, object]:
    """All that a map server answers, as far as it depends on the map."""
    points = np.random.default_rng(3).uniform(-1.6, 1.6, (3000, 3))
    asked = query(client, points, with_color=True, with_distance=True, max_distance_m=2.0)
    mesh = client.call(GetMesh, topics.GET_MESH, GetMesh.Request(resolution_m=0.06))
    grid = client.call(
        GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, GetOccupancyGrid.Request(resolution_m=0.05)
    )
    regions = client.call(ListRegions, topics.LIST_REGIONS)
    for answer in (asked, mesh, grid, regions):
        assert answer.result == Code.SUCCESS, answer.message
    bits = {
        "probability": np.array(asked.probability).tobytes(),
        "distances": np.array(asked.distances_m).tobytes(),
        "occupancy": bytes(np.array(asked.occupancy, np.int8)),
        "colors": bytes(asked.colors),
        "vertices": np.array(mesh.vertices).tobytes(),
        "triangles": np.array(mesh.triangles).tobytes(),
        "grid": bytes(np.array(grid.grid.data, np.int8)),
        "origin": str(grid.grid.info.origin),
        "regions": str(regions.regions),
    }
    assert len(mesh.triangles) > 1000
    return bits


def test_a_server_alone_on_a_stored_map_answers_as_the_live_one(
    start_node, client, folders
) -> None:
    live = start_node(MapServerNode, **folders)
    fill(client, *two_regions())
    before = everything(client)
    save(client)
    live.trigger_shutdown()
    # Nobody publishes regions any more.
    with MeslamClient("alone") as other:
        client.close()
        start_node(MapServerNode, map="room.meslam", restore=False, **folders)
        assert other.spin_until(lambda: len(listed(other).regions.regions) == 2, WAIT_S)
        after = everything(other)
    assert {name for name in before if before[name] != after[name]} == set()


def test_a_map_that_is_not_there_keeps_the_server_from_starting(start_node, folders, capfd) -> None:
    server = start_node(MapServerNode, map="nothing.meslam", **folders)
    assert not server.configured
    assert "there is no map" in capfd.readouterr().err


def test_distances_reach_as_far_as_asked(start_node, client, folders) -> None:
    start_node(MapServerNode, **folders)
    fill(client, two_regions()[0])
    points = np.random.default_rng(5).uniform(-1.3, 1.3, (3000, 3))
    truth = SCENE.distance_m(points)
    for farthest_m in (0.0, 0.3, 5.0):
        answer = query(client, points, with_distance=True, max_distance_m=farthest_m)
        distance = np.frombuffer(answer.distances_m, np.float32)
        known = np.array(answer.occupancy) != -1
        np.testing.assert_array_equal(np.isfinite(distance), known)
        free = known & (truth > 0.02)
        limit = farthest_m or 0.1
        error = np.abs(distance[free] - truth[free].clip(None, limit))
        assert np.median(error) < 0.01
        assert np.quantile(error, 0.99) < 0.04
        behind = known & (truth < -0.02)
        assert (distance[behind] < 0).mean() > 0.95


def test_a_part_of_the_grid_is_cut_out_of_the_whole(start_node, client, folders) -> None:
    start_node(MapServerNode, **folders)
    fill(client, two_regions()[0])

    def grid(**fields) -> tuple[np.ndarray, np.ndarray]:
        request = GetOccupancyGrid.Request(resolution_m=0.1, **fields)
        if request.use_box:
            request.box_min.x, request.box_min.y = -0.5, -0.2
            request.box_max.x, request.box_max.y = 0.7, 1.1
        answer = client.call(GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, request)
        assert answer.result == Code.SUCCESS, answer.message
        info = answer.grid.info
        cells = np.array(answer.grid.data).reshape(info.height, info.width)
        return cells, np.array([info.origin.position.x, info.origin.position.y])

    (whole, origin), (part, corner) = grid(), grid(use_box=True)
    assert part.shape == (13, 12)
    np.testing.assert_allclose(corner, [-0.5, -0.2], atol=1e-9)
    column, row = np.rint((corner - origin) / 0.1).astype(int)
    np.testing.assert_array_equal(part, whole[row : row + 13, column : column + 12])


@pytest.mark.parametrize("mode", [LoadMap.Request.CONTINUE, LoadMap.Request.LOCALISE])
def test_a_stored_map_is_loaded_into_a_running_system(start_node, client, folders, mode) -> None:
    start_node(OdometryNode)
    start_node(TrackingNode, **FAST)
    start_node(MapServerNode, **folders)
    camera = Camera(client)
    camera.wait(nodes=2)
    for number in range(6):
        status = camera.track(number)
    stored_id = status.map_id
    assert client.spin_until(
        lambda: client.settled and bool(listed(client).regions.regions), WAIT_S
    )
    save(client)
    # Another map begins; its frame is that of a later view.
    assert client.call(Trigger, topics.RESET).success
    status = camera.track(6)
    assert status.map_id != stored_id
    at = POSES[7] @ inverse(T_BODY_OPTICAL)
    request = LoadMap.Request(
        name="room.meslam", mode=mode, use_start_pose=True, start_pose=to_pose(at)
    )
    answer = client.call(LoadMap, topics.LOAD_MAP, request)
    assert (answer.result, answer.map_id) == (Code.SUCCESS, stored_id), answer.message
    assert listed(client).regions.map_id == stored_id
    for repeated in range(200):
        status = camera.track(7, later_ns=(repeated + 1) * 1_000_000)
        if status.map_id == stored_id:
            break
    assert status.map_id == stored_id
    gone_over_ns = client.last_stamp_ns
    for number in range(8, len(POSES)):
        status = camera.track(number)
        assert status.state == TrackingStatus.OK, status.reason
    assert status.localising == (mode == LoadMap.Request.LOCALISE)
    for stamp, T_map_base in client.poses.items():
        if stamp > gone_over_ns:
            number = round((stamp - NANOSECONDS) / 66_666_667)
            truth = POSES[number] @ inverse(T_BODY_OPTICAL)
            assert np.linalg.norm((inverse(truth) @ T_map_base)[:3, 3]) < 0.02
    assert client.spin_until(lambda: client.settled, ANSWER_S)
    regions = listed(client).regions
    assert regions.map_id == stored_id
    answer = query(client, (at[:3, 3] + 0.3 * at[:3, 0])[None])
    assert list(answer.occupancy) == [0]
