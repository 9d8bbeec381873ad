"""The export action: progress, cancel, one at a time; what it writes is what the service writes."""

from __future__ import annotations

from pathlib import Path

import pytest
from data.map_client import WAIT_S, Code, fill, two_regions
from rclpy.action import ActionClient

from meslam_interfaces.action import ExportMap
from meslam_interfaces.srv import ExportMap as ExportService
from meslam_ros import topics
from meslam_ros.map_server_node import MapServerNode

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


class Exporter:
    """An action client that keeps what it hears."""

    def __init__(self, client) -> None:
        self._client = client
        self._actions = ActionClient(client.node, ExportMap, topics.EXPORT)
        self.feedback: list[ExportMap.Feedback] = []
        assert client.spin_until(self._actions.server_is_ready, WAIT_S)

    def send(self, **fields):
        """A goal's handle, once the server has taken it."""
        goal = ExportMap.Goal(**{"path": "mesh.ply", **fields})
        sent = self._actions.send_goal_async(goal, lambda m: self.feedback.append(m.feedback))
        assert self._client.spin_until(sent.done, WAIT_S)
        assert sent.result().accepted
        return sent.result()

    def result(self, handle) -> tuple[int, ExportMap.Result]:
        """How a goal ended, and its result."""
        ended = handle.get_result_async()
        assert self._client.spin_until(ended.done, WAIT_S)
        return ended.result().status, ended.result().result

    def cancel(self, handle) -> None:
        asked = handle.cancel_goal_async()
        assert self._client.spin_until(asked.done, WAIT_S)

    def close(self) -> None:
        self._actions.destroy()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "exports"


@pytest.fixture
def exporter(start_node, client, folder):
    start_node(MapServerNode, export_folder=str(folder), map_folder=str(folder.parent / "maps"))
    fill(client, *two_regions())
    exporter = Exporter(client)
    yield exporter
    exporter.close()


def test_progress_is_told_and_the_mesh_is_the_services(exporter, client, folder) -> None:
    status, result = exporter.result(exporter.send(resolution_m=0.04))
    assert (status, result.result) == (SUCCEEDED, Code.SUCCESS), result.message
    assert (folder / "mesh.ply").stat().st_size == result.bytes > 0
    assert client.spin_until(lambda: exporter.feedback[-1:] != [], WAIT_S)
    assert client.spin_until(lambda: exporter.feedback[-1].stage == "writing", WAIT_S)
    assert {feedback.stage for feedback in exporter.feedback} == {"meshing", "writing"}
    done = [feedback.done for feedback in exporter.feedback]
    assert done == sorted(done)
    assert done[-1] == exporter.feedback[-1].total > 0
    request = ExportService.Request(path="service.ply", resolution_m=0.04)
    answer = client.call(ExportService, topics.EXPORT_MAP, request)
    assert answer.triangles == result.triangles
    assert (folder / "service.ply").read_bytes() == (folder / "mesh.ply").read_bytes()


def test_a_cancelled_export_leaves_nothing_and_the_next_one_works(exporter, client, folder) -> None:
    handle = exporter.send(resolution_m=0.005)
    assert client.spin_until(lambda: bool(exporter.feedback), WAIT_S)
    second = exporter.send(path="other.ply", resolution_m=0.1)
    status, refused = exporter.result(second)
    assert (status, refused.result) == (ABORTED, Code.BUSY), refused.message
    exporter.cancel(handle)
    status, result = exporter.result(handle)
    assert (status, result.result) == (CANCELED, Code.CANCELLED), result.message
    assert not folder.exists() or list(folder.rglob("*")) == []
    status, result = exporter.result(exporter.send(resolution_m=0.1))
    assert (status, result.result) == (SUCCEEDED, Code.SUCCESS), result.message


def test_goals_that_cannot_be_met_are_aborted_with_their_code(exporter, folder) -> None:
    for fields, code, word in (
        ({"path": "../mesh.ply"}, Code.INVALID_REQUEST, "'..'"),
        ({"path": "mesh.stl"}, Code.INVALID_REQUEST, ".ply"),
        ({"resolution_m": -1.0}, Code.INVALID_REQUEST, "resolution"),
        ({"use_box": True}, Code.INVALID_REQUEST, "box"),
    ):
        status, result = exporter.result(exporter.send(**fields))
        assert (status, result.result) == (ABORTED, code), result.message
        assert word in result.message
    assert not folder.exists()
