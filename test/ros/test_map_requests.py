"""Malformed requests: each gets its code and a message, nothing crashes, nothing is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from data.map_client import Code, fill, listed, query, two_regions
from geometry_msgs.msg import Pose

from meslam_interfaces.msg import RegionIndex
from meslam_interfaces.srv import (
    ExportMap,
    GetMesh,
    GetOccupancyGrid,
    LoadMap,
    QueryOccupancy,
    SaveMap,
)
from meslam_ros import topics
from meslam_ros.map_server_node import MapServerNode

NAN, INFINITY = float("nan"), float("inf")
NAMES = {
    ExportMap: topics.EXPORT_MAP,
    GetMesh: topics.GET_MESH,
    GetOccupancyGrid: topics.GET_OCCUPANCY_GRID,
    LoadMap: topics.LOAD_MAP,
    QueryOccupancy: topics.QUERY_OCCUPANCY,
    SaveMap: topics.SAVE_MAP,
}
INVALID, MISSING, LARGE = Code.INVALID_REQUEST, Code.NOT_FOUND, Code.TOO_LARGE
Case = tuple[type, dict[str, Any], int, str]

BAD_NAMES: list[tuple[str, str]] = [
    ("/tmp/mesh.ply", "leading"),
    ("../mesh.ply", "'..'"),
    ("a/../../mesh.ply", "'..'"),
    ("", "name"),
    (".", "name"),
    ("x" * 300 + ".ply", "name"),
    ("linked/mesh.ply", "leads out"),
    ("mesh_link.ply", "leads out"),
]
BAD_RESOLUTIONS = [-1.0, NAN, INFINITY, -INFINITY, 1e-6, -1e-30, 1e6]
BAD_BOXES = [(1.0, -1.0), (0.0, 0.0), (NAN, 1.0), (-INFINITY, INFINITY)]


def point(value: float) -> dict[str, float]:
    return {"x": value, "y": value, "z": value}


def box(low: float, high: float) -> dict[str, Any]:
    return {"use_box": True, "box_min": point(low), "box_max": point(high)}


def header(frame: str, **stamp: int) -> dict[str, Any]:
    return {"header": {"frame_id": frame, "stamp": stamp}}


FAR_REGION = [RegionIndex(index=[5, 5, 5])]
ORIGIN = [0.0, 0.0, 0.0]
CASES: list[Case] = [
    *((ExportMap, {"path": name}, INVALID, word) for name, word in BAD_NAMES),
    (ExportMap, {"path": "loop.ply"}, INVALID, "loop.ply"),
    (ExportMap, {"path": "mesh.exe"}, INVALID, ".ply"),
    (ExportMap, {"path": "mesh"}, INVALID, ".ply"),
    *(
        (ExportMap, {"path": "mesh.ply", "resolution_m": value}, INVALID, "resolution")
        for value in BAD_RESOLUTIONS
    ),
    (ExportMap, {"path": "mesh.ply", "resolution_m": 0.006}, LARGE, "max_cells"),
    *((ExportMap, {"path": "mesh.ply", **box(*ends)}, INVALID, "box") for ends in BAD_BOXES),
    (ExportMap, {"path": "mesh.ply", **box(50.0, 60.0)}, Code.EMPTY_MAP, "no surface"),
    (ExportMap, {"path": "mesh.ply", **box(1e30, 1e300)}, Code.EMPTY_MAP, "no surface"),
    (ExportMap, {"path": "mesh.ply", "regions": FAR_REGION}, MISSING, "(5, 5, 5)"),
    (ExportMap, {"path": "folder.ply"}, Code.IO_ERROR, "folder.ply"),
    *((GetMesh, {"resolution_m": value}, INVALID, "resolution") for value in BAD_RESOLUTIONS),
    (GetMesh, {"resolution_m": 0.006}, LARGE, "max_cells"),
    *((GetMesh, box(*ends), INVALID, "box") for ends in BAD_BOXES),
    (GetMesh, {"regions": FAR_REGION}, MISSING, "(5, 5, 5)"),
    *((SaveMap, {"name": name}, INVALID, word) for name, word in BAD_NAMES if name),
    (SaveMap, {"name": "foreign"}, Code.IO_ERROR, "no map"),
    *((LoadMap, {"name": name}, INVALID, word) for name, word in BAD_NAMES),
    (LoadMap, {"name": "nothing.meslam"}, MISSING, "no map"),
    (LoadMap, {"name": "foreign"}, Code.INVALID_DATA, "foreign"),
    (LoadMap, {"name": "nothing.meslam", "mode": 9}, INVALID, "mode 9"),
    (QueryOccupancy, {}, INVALID, "no points"),
    (QueryOccupancy, {"points": [1.0, 2.0]}, INVALID, "x, y, z"),
    (QueryOccupancy, {"points": [*ORIGIN, NAN, 0.0, 0.0]}, INVALID, "point 1"),
    (QueryOccupancy, {"points": [0.0, INFINITY, 0.0]}, INVALID, "point 0"),
    (QueryOccupancy, {"points": [0.0] * 3003}, LARGE, "max_points"),
    (QueryOccupancy, {"points": ORIGIN, **header("nowhere")}, MISSING, "nowhere"),
    (QueryOccupancy, {"points": ORIGIN, **header("x" * 5000)}, MISSING, "TF"),
    *(
        (QueryOccupancy, {"points": ORIGIN, "max_distance_m": value}, INVALID, "distance")
        for value in (NAN, INFINITY, -1.0, 1e9)
    ),
    *((GetOccupancyGrid, {"resolution_m": v}, INVALID, "resolution") for v in BAD_RESOLUTIONS),
    *(
        (
            GetOccupancyGrid,
            {"use_heights": True, "min_height_m": low, "max_height_m": high},
            code,
            word,
        )
        for low, high, code, word in (
            (1.0, -1.0, INVALID, "lowest first"),
            (NAN, 1.0, INVALID, "lowest first"),
            (-INFINITY, INFINITY, INVALID, "lowest first"),
            (-3e38, 3e38, LARGE, "max_cells"),
        )
    ),
    *((GetOccupancyGrid, box(*ends), INVALID, "box") for ends in BAD_BOXES),
    (GetOccupancyGrid, box(-1e6, 1e6), LARGE, "max_cells"),
    (GetOccupancyGrid, box(-1e300, 1e300), LARGE, "max_cells"),
]


def filled(message: Any, values: dict[str, Any]) -> Any:
    """A message with the values of a nested dictionary."""
    for name, value in values.items():
        if isinstance(value, dict):
            filled(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder for exports and maps that holds traps, and one outside of it."""
    folder, outside = tmp_path / "inside", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (folder / "linked").symlink_to(outside)
    (folder / "mesh_link.ply").symlink_to(outside / "mesh.ply")
    (folder / "loop.ply").symlink_to(folder / "loop.ply")
    (folder / "folder.ply").mkdir()
    (folder / "foreign").mkdir()
    (folder / "foreign" / "notes.txt").write_text("mine")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and "recent" not in path.parts)
    return {str(path): path.read_bytes() for path in files}


def test_malformed_requests_get_their_code_and_harm_nothing(start_node, client, folder) -> None:
    start_node(
        MapServerNode,
        max_points=1000,
        max_cells=3_000_000,
        export_folder=str(folder),
        map_folder=str(folder),
    )
    fill(client, two_regions()[0])
    before = contents(folder.parent)
    wrong = []
    for kind, values, code, word in CASES:
        answer = client.call(kind, NAMES[kind], filled(kind.Request(), values))
        if answer.result != code or word not in answer.message:
            wrong.append((kind.__name__, values, answer.result, answer.message))
    assert wrong == []
    assert contents(folder.parent) == before
    assert len(listed(client).regions.regions) == 1
    assert query(client, [[1.2, 0, 0]]).result == Code.SUCCESS


def test_an_unfinished_export_leaves_nothing_beside(start_node, client, folder) -> None:
    start_node(MapServerNode, export_folder=str(folder), map_folder=str(folder))
    fill(client, two_regions()[0])
    for suffix in ("ply", "obj", "glb"):
        (folder / f"taken.{suffix}").mkdir()
        request = ExportMap.Request(path=f"taken.{suffix}", resolution_m=0.1)
        answer = client.call(ExportMap, topics.EXPORT_MAP, request)
        assert (answer.result, answer.path) == (Code.IO_ERROR, ""), answer.message
        assert list((folder / f"taken.{suffix}").iterdir()) == []
    assert not [path for path in folder.iterdir() if path.name.startswith((".", "tmp"))]


def test_without_tracking_a_map_can_only_be_viewed(start_node, client, folder) -> None:
    start_node(MapServerNode, export_folder=str(folder), map_folder=str(folder))
    fill(client, two_regions()[0])
    saved = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name="room.meslam"))
    assert saved.result == Code.SUCCESS, saved.message
    request = LoadMap.Request(
        name="room.meslam", mode=LoadMap.Request.CONTINUE, use_start_pose=True, start_pose=Pose()
    )
    answer = client.call(LoadMap, topics.LOAD_MAP, request)
    assert answer.result == Code.NOT_FOUND
    assert "no tracking node" in answer.message
    assert query(client, [[1.2, 0, 0]]).result == Code.SUCCESS
