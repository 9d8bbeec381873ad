"""Nodes that are killed in the middle of a run and started again: nothing learnt is lost."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from data import ros_domain
from data.ros_camera import CameraDriver
from data.textured_room import frame_at, path

from meslam_core.map.store import MapStore
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_interfaces.srv import ListRegions, LoadMap, SaveMap
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import latched

ros_domain.enter()

NODES = ("map_server_node", "region_manager_node", "odometry_node", "tracking_node")
STARTING_S = 90.0
ANSWER_S = 60.0
RESEND_S = 5.0
THERE = path(12, step_m=0.008, step_deg=0.4)
POSES = [*THERE, *THERE[-2:0:-1]]
QUICK = {
    "mapping.first_iterations": 150,
    "mapping.iterations": 8,
    "mapping.keyframe_iterations": 10,
    "mapping.final_iterations": 20,
    "keyframes.rays": 2048,
    "model_period_s": 0.1,
    "idle_s": 0.3,
    "keep_period_s": 0.1,
}


class System:
    """All nodes as processes, and a camera that waits for the answer to each of its images."""

    def __init__(self, client: MeslamClient, folder: Path) -> None:
        self.client = client
        self.folder = folder
        self.camera = CameraDriver(client.node)
        self.models: dict[str, RegionModel] = {}
        self.processes: dict[str, NodeProcess] = {}
        self._place = self._number = 0
        client.node.create_subscription(
            RegionModel, topics.REGION_MODELS, self._take_model, latched(100)
        )

    def start(self, node: str, name: str = "", *remappings: str) -> None:
        name = name or node
        extra = [word for remapping in remappings for word in ("-r", remapping)]
        if name != node:
            extra += ["-r", f"__node:={name}"]
        folder = self.folder / name if name != node else self.folder
        arguments = ros_arguments({**QUICK, "map_folder": folder}, extra)
        self.processes[name] = NodeProcess(node, arguments, log=self.folder / f"{name}.log")

    def kill(self, name: str) -> None:
        self.processes[name].signal(signal.SIGKILL)
        assert self.processes[name].wait(ANSWER_S) == -signal.SIGKILL

    def until(self, condition) -> None:
        assert self.client.spin_until(condition, STARTING_S), self.logs()

    def frame(self) -> TrackingStatus:
        """Send the next view, again and again while nobody listens; tracking's answer."""
        before = len(self.client.statuses)
        self._place += 1
        deadline = time.monotonic() + STARTING_S
        while time.monotonic() < deadline and self.processes["tracking_node"].status is None:
            self._number += 1
            frame = frame_at(POSES[self._place % len(POSES)], self._number)
            self.camera.send(replace(frame, stamp_ns=frame.stamp_ns + NANOSECONDS))
            if self.client.spin_until(lambda: len(self.client.statuses) > before, RESEND_S):
                return self.client.statuses[-1]
        raise AssertionError(self.logs())

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        """Ask a service, again where the one asked was killed, which shows only after a while."""
        deadline = time.monotonic() + STARTING_S
        while True:
            try:
                return self.client.call(kind, name, request, timeout_s=RESEND_S)
            except TimeoutError:
                assert time.monotonic() < deadline, self.logs()

    def listed(self) -> dict[tuple[int, ...], int]:
        """The map server's regions and their versions."""
        regions = self.call(ListRegions, topics.LIST_REGIONS).regions
        self.map_id = regions.map_id
        return {tuple(region.index): region.version for region in regions.regions}

    def served(self, map_id: str) -> bool:
        """Whether the map server has all that was published of a map."""
        models = [model for model in self.models.values() if model.map_id == map_id]
        if sum(len(model.data) for model in models) != self.client.statuses[-1].map_bytes:
            return False
        known = {tuple(model.index): model.version for model in models}
        return self.listed() == known and self.map_id == map_id

    def settle(self) -> str:
        """Wait until the map is refined, published and served; its identity."""
        self.until(lambda: self.client.settled)
        map_id = self.client.statuses[-1].map_id
        self.until(lambda: self.served(map_id))
        return map_id

    def saved(self, name: str, service: str = topics.SAVE_MAP) -> dict[tuple[int, ...], str]:
        """Save the map; checksums of its regions."""
        answer = self.call(SaveMap, service, SaveMap.Request(name=name))
        assert answer.result == answer.SUCCESS, answer.message
        return checksums(Path(answer.path))

    def logs(self) -> str:
        return "\n".join(f"--- {name}\n{p.output()}" for name, p in self.processes.items())

    def _take_model(self, model: RegionModel) -> None:
        self.models[str((model.map_id, tuple(model.index)))] = model


def checksums(folder: Path) -> dict[tuple[int, ...], str]:
    return {entry.index: entry.sha256 for entry in MapStore(folder).manifest().regions}


def stored_versions(folder: Path) -> dict[tuple[int, ...], int]:
    return {entry.index: entry.version for entry in MapStore(folder).manifest().regions}


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    with MeslamClient("killer") as client:
        system = System(client, tmp_path)
        try:
            for node in NODES:
                system.start(node)
            yield system
            assert "Traceback" not in system.logs()
        finally:
            for process in system.processes.values():
                process.stop()


def test_any_node_may_be_killed_and_nothing_is_lost(system: System) -> None:
    for _ in range(4):
        assert system.frame().state == TrackingStatus.OK
    first_map = system.settle()
    before = system.saved("before")
    assert before == {
        tuple(m.index): m.sha256 for m in system.models.values() if m.map_id == first_map
    }

    # The map server: one that is started again and one that comes late reach the same map.
    system.kill("map_server_node")
    assert system.frame().map_id == first_map
    system.start("map_server_node")
    system.settle()
    late = "late/save_map"
    names = (topics.EXPORT_MAP, topics.GET_MESH, topics.LIST_REGIONS, topics.LOAD_MAP)
    system.start(
        "map_server_node",
        "late_server",
        f"{topics.SAVE_MAP}:={late}",
        *(f"{name}:=late/{name}" for name in names),
    )
    known = system.saved("again")
    system.until(
        lambda: system.call(SaveMap, late, SaveMap.Request(name="x")).regions == len(known)
    )
    assert system.saved("late", late) == known

    # The region manager.
    system.kill("region_manager_node")
    system.client.regions = None
    system.start("region_manager_node")
    system.until(lambda: system.client.regions is not None and bool(system.client.regions.regions))
    assert system.client.regions.map_id == first_map

    # Odometry: tracking goes on without it, and with it when it is back.
    system.kill("odometry_node")
    assert system.frame().state == TrackingStatus.OK
    system.start("odometry_node")
    statuses: list[TrackingStatus] = []

    def guided() -> bool:
        statuses.append(system.frame())
        return statuses[-1].odometry_valid

    system.until(guided)
    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert all(status.map_id == first_map for status in statuses)
    system.settle()
    last = system.saved("last")

    # Tracking: it begins a new map, and the one before is still there for whoever wants it.
    system.kill("tracking_node")
    system.start("tracking_node")
    system.until(lambda: system.frame().map_id != first_map)
    second_map = system.settle()
    kept = system.folder / "recent" / first_map
    assert checksums(kept) == last
    assert second_map != first_map
    stored = LoadMap.Request(name=f"recent/{first_map}")
    answer = system.call(LoadMap, topics.LOAD_MAP, stored)
    assert answer.result == answer.SUCCESS, answer.message
    assert answer.map_id == first_map
    assert system.saved("loaded") == last


def test_a_map_server_alone_finds_its_map_again(system: System) -> None:
    for _ in range(2):
        system.frame()
    map_id = system.settle()
    versions = system.listed()
    kept = system.folder / "recent" / map_id
    system.until(lambda: kept.is_dir() and stored_versions(kept) == versions)
    system.kill("tracking_node")
    system.kill("map_server_node")
    system.start("map_server_node")
    system.until(lambda: system.listed() == versions)
    assert system.map_id == map_id
