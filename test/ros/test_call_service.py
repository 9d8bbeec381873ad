from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from std_srvs.srv import SetBool

from meslam_interfaces.msg import RegionIndex
from meslam_interfaces.srv import ExportMap, QueryOccupancy
from meslam_ros.call_service import CallError, fill, run, shown
from meslam_ros.map_server_node import MapServerNode


def ask(*arguments: str) -> tuple[int, str]:
    """Exit status and output of a call."""
    lines: list[str] = []
    return run(arguments, lines.append), "\n".join(lines)


@pytest.fixture
def server(start_node, tmp_path: Path) -> MapServerNode:
    folders = {"export_folder": str(tmp_path), "map_folder": str(tmp_path)}
    return start_node(MapServerNode, **folders)


def test_services_are_listed_and_called_by_name_alone(server) -> None:
    status, output = ask()
    assert status == 0
    assert "/meslam/list_regions  meslam_interfaces/srv/ListRegions" in output
    assert "get_parameters" not in output
    status, output = ask("/meslam/list_regions")
    answer = yaml.safe_load(output)
    assert status == (0 if answer["result"] == 0 else 1)
    assert answer["regions"]["regions"] == []


def test_a_refusal_is_seen_in_the_status_and_said(server) -> None:
    status, output = ask("/meslam/load_map", "{name: nothing.meslam}")
    assert status == 1
    assert "nothing.meslam" in yaml.safe_load(output)["message"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("/meslam/export_map", "{pth: a.ply}"), "no field pth; there are path"),
        (("/meslam/export_map", "{resolution_m: fine}"), "float"),
        (("/meslam/export_map", "{path"), "no YAML"),
        (("/meslam/export_map", "a.ply"), "expected {path"),
        (("/meslam/exprt_map",), "/meslam/export_map"),
    ],
)
def test_what_cannot_be_asked_is_named(server, capsys, arguments, words, monkeypatch) -> None:
    monkeypatch.setattr("meslam_ros.call_service.DISCOVERY_S", 3.0)
    status, output = ask(*arguments)
    assert (status, output) == (2, "")
    assert words in capsys.readouterr().err


def test_requests_of_every_shape_are_filled() -> None:
    request = fill(
        ExportMap.Request(),
        {
            "path": "room.ply",
            "resolution_m": 1,
            "box_min": {"x": 1, "y": -2.5},
            "regions": [{"index": [1, 0, 0]}, {"index": [0, -2, 0]}],
        },
    )
    assert (request.path, request.resolution_m) == ("room.ply", 1.0)
    assert (request.box_min.x, request.box_min.y) == (1.0, -2.5)
    assert [list(region.index) for region in request.regions] == [[1, 0, 0], [0, -2, 0]]
    points = fill(QueryOccupancy.Request(), {"points": [1, 2, 3], "header": {"frame_id": "map"}})
    np.testing.assert_array_equal(points.points, [1.0, 2.0, 3.0])
    with pytest.raises(CallError, match="data is boolean"):
        fill(SetBool.Request(), {"data": "yes"})


def test_long_arrays_are_shortened() -> None:
    response = QueryOccupancy.Response(probability=[0.5] * 100)
    assert shown(response)["probability"][-1] == "... and 90 more"
    assert shown(response)["result"] == 0
    assert shown(RegionIndex(index=[1, -2, 3])) == {"index": [1, -2, 3]}
