"""Services and parameters of running nodes that are asked for nonsense."""

from __future__ import annotations

import array
from collections.abc import Iterator
from typing import Any

import numpy as np
from faults.live_graph import LiveGraph
from faults.live_trial import live
from geometry_msgs.msg import Point
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from meslam_interfaces.msg import RegionIndex
from meslam_interfaces.srv import (
    ExportMap,
    GetMesh,
    GetOccupancyGrid,
    LoadMap,
    QueryOccupancy,
    SaveMap,
    UseMap,
)
from meslam_ros import topics
from meslam_ros.conversions import numbers

NAN = float("nan")
MAP_SIDE = ("map_server_node", "tracking_node")
REFUSED = "each is refused with a code and a message, none of them a defect; the map stays as it is"
Asked = tuple[Any, str, Any]


def paths(graph: LiveGraph) -> Iterator[Asked]:
    """Names that lead out of the folders, or are none."""
    names = ("../stolen.ply", "/tmp/stolen.ply", "", "..", "a/../../b.ply", 300 * "a" + ".ply")
    (graph.folder / "exports").mkdir(exist_ok=True)
    (graph.folder / "exports" / "link").symlink_to("/tmp")
    for name in (*names, "link/stolen.ply", 250 * "a" + ".ply", "no_format"):
        yield ExportMap, topics.EXPORT_MAP, ExportMap.Request(path=name)
    for name in ("../stolen", "/etc", "a/../.."):
        yield SaveMap, topics.SAVE_MAP, SaveMap.Request(name=name)
        yield LoadMap, topics.LOAD_MAP, LoadMap.Request(name=name)
    yield LoadMap, topics.LOAD_MAP, LoadMap.Request(name="missing")
    yield LoadMap, topics.LOAD_MAP, LoadMap.Request(name="recent", mode=77)


def points(graph: LiveGraph) -> Iterator[Asked]:
    """Points that are none, or too many."""
    for values in ([], [0.0, 1.0], [NAN, 0.0, 0.0], [np.inf, 0.0, 0.0]):
        asked = QueryOccupancy.Request(points=array.array("f", values))
        yield QueryOccupancy, topics.QUERY_OCCUPANCY, asked
    many = QueryOccupancy.Request(points=numbers("f", np.zeros(3 * 2_000_001)))
    yield QueryOccupancy, topics.QUERY_OCCUPANCY, many
    for farthest_m in (NAN, -1.0, 1e30):
        asked = QueryOccupancy.Request(points=array.array("f", [0.0] * 3), with_distance=True)
        asked.max_distance_m = farthest_m
        yield QueryOccupancy, topics.QUERY_OCCUPANCY, asked
    elsewhere = QueryOccupancy.Request(points=array.array("f", [0.0] * 3))
    elsewhere.header.frame_id = "nowhere"
    yield QueryOccupancy, topics.QUERY_OCCUPANCY, elsewhere


def shapes(graph: LiveGraph) -> Iterator[Asked]:
    """Resolutions, boxes and regions that do not exist."""
    for resolution_m in (-1.0, NAN, 1e-9, 1e9):
        yield GetMesh, topics.GET_MESH, GetMesh.Request(resolution_m=resolution_m)
        grid = GetOccupancyGrid.Request(resolution_m=resolution_m)
        yield GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, grid
    for low, high in ((1.0, -1.0), (NAN, 1.0), (1e30, 1e31), (-1e308, 1e308)):
        corners = {"box_min": Point(x=low, y=low, z=low), "box_max": Point(x=high, y=high, z=high)}
        if low != -1e308:
            # A mesh within all there is, is the whole mesh; a grid over it has too many cells.
            yield GetMesh, topics.GET_MESH, GetMesh.Request(use_box=True, **corners)
        grid = GetOccupancyGrid.Request(use_box=True, **corners)
        yield GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, grid
    nowhere = [RegionIndex(index=np.array([9, 9, 9], np.int32))]
    yield GetMesh, topics.GET_MESH, GetMesh.Request(regions=nowhere)
    for low, high in ((NAN, 1.0), (2.0, -2.0), (-1e38, 1e38)):
        heights = GetOccupancyGrid.Request(use_heights=True, min_height_m=low, max_height_m=high)
        yield GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, heights


def maps_to_use(graph: LiveGraph) -> Iterator[Asked]:
    """Maps that tracking is to go over to, and that are none."""
    model = next(iter(graph.models.values()))
    known = {"map_id": model.map_id, "mode": 1}
    lattice = {"lattice_side_m": model.size_m.x, "overlap": 0.2}
    requests = [
        UseMap.Request(**known),
        UseMap.Request(map_id="another", mode=1, regions=[model], **lattice),
        UseMap.Request(map_id=model.map_id, mode=9, regions=[model], **lattice),
        UseMap.Request(**known, regions=[model], lattice_side_m=NAN),
        UseMap.Request(**known, regions=[model, model], **lattice),
    ]
    astray = UseMap.Request(**known, regions=[model], use_start_pose=True, **lattice)
    astray.start_pose.orientation.w = NAN
    for request in (*requests, astray):
        yield UseMap, topics.USE_MAP, request


def all_refused(requests):
    """Ask one after the other."""

    def disturb(graph: LiveGraph) -> str:
        map_id = graph.settle()
        count = 0
        for kind, name, request in requests(graph):
            answer = graph.client.call(kind, name, request, timeout_s=300.0)
            told = f"{name}: {answer.result}, {answer.message}"
            assert answer.result not in (answer.SUCCESS, answer.INTERNAL_ERROR), told
            assert answer.message, f"{name} refuses in silence"
            count += 1
        assert graph.served() == graph.published(map_id), "the map has changed"
        return f"{count} of {count} refused with a code and a message"

    return disturb


def nonsense_parameters(graph: LiveGraph) -> str:
    """Values of the wrong type, out of range, unknown, and too late."""
    count = 0
    for node, values in {
        "tracking_node": {
            "queue_size": -5,
            "model_period_s": NAN,
            "overload_share": float("inf"),
            "max_wait_s": "long",
            "mapping.iterations": 10**12,
            "map_frame": "elsewhere",
            "field.width": 7,
            "no.such.parameter": 1,
        },
        "map_server_node": {
            "max_points": 0,
            "max_cells": -1,
            "grid_min_height_m": NAN,
            "kept_maps": "all",
            "map_folder": "/etc",
        },
        "odometry_node": {"odometry_queue_size": 0, "sync_tolerance_s": -1.0},
    }.items():
        for name, value in values.items():
            wanted = Parameter(name, value=value).to_parameter_msg()
            answer = graph.client.call(
                SetParameters, f"{node}/set_parameters", SetParameters.Request(parameters=[wanted])
            )
            (result,) = answer.results
            assert not result.successful, f"{node} takes {name} = {value}"
            assert result.reason, f"{node} refuses {name} = {value} in silence"
            count += 1
    return f"{count} of {count} refused with a reason"


FAULTS = (
    live(
        "live-service-paths",
        "services asked for files and maps outside of their folders, over links, of no name",
        REFUSED,
        all_refused(paths),
        MAP_SIDE,
    ),
    live(
        "live-service-points",
        "queries with points of NaN, halves of points, two million and one points, unknown frames",
        REFUSED,
        all_refused(points),
        MAP_SIDE,
    ),
    live(
        "live-service-shapes",
        "meshes and grids with negative resolutions, NaN boxes, 1e308 m boxes, unknown regions",
        REFUSED,
        all_refused(shapes),
        MAP_SIDE,
    ),
    live(
        "live-service-use-map",
        "tracking told to use maps that are empty, contradict themselves, or come twice",
        REFUSED,
        all_refused(maps_to_use),
        MAP_SIDE,
    ),
    live(
        "live-parameters",
        "parameters set to nonsense while the nodes run",
        "each is refused with a reason; the nodes go on",
        nonsense_parameters,
    ),
)
