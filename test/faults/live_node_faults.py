"""Nodes that are killed, stopped or starved, and folders that vanish, fill up or are held."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from faults.fault import SkippedError
from faults.live_graph import LiveGraph
from faults.live_trial import CAMERA_SIDE, Disturbance, live
from geometry_msgs.msg import PoseStamped

from meslam_core.map.store import MapStore
from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import SaveMap
from meslam_ros import topics
from meslam_ros.conversions import stamp_ns
from meslam_ros.qos import STREAM

ALL = ("map_server_node", "region_manager_node", *CAMERA_SIDE)
STOPPED_S = 3.0
FAST_S = 1 / 30
SLICE_S = 0.1
SHARE = 0.25


class Clocked:
    """How old poses are when they come, by this computer's clock."""

    def __init__(self, graph: LiveGraph) -> None:
        self._graph = graph
        self._sent: dict[int, float] = {}
        self.ages: list[tuple[float, float]] = []
        graph.client.node.create_subscription(PoseStamped, topics.POSE, self._take, STREAM)

    def stream(self, seconds: float, period_s: float) -> None:
        """Send views at a rate, however slowly they are answered."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            due = time.monotonic() + period_s
            sent_s = time.monotonic()
            self._sent[self._graph.send()] = sent_s
            self._graph.wait(max(0.0, due - time.monotonic()))

    def oldest_s(self, since_s: float) -> float:
        """Greatest age of the poses that came since then [s]."""
        return max((age for came, age in self.ages if came >= since_s), default=0.0)

    def _take(self, message: PoseStamped) -> None:
        now = time.monotonic()
        sent = self._sent.get(stamp_ns(message.header.stamp))
        if sent is not None:
            self.ages.append((now, now - sent))


def killed(node: str) -> Disturbance:
    """A node that is killed and started again."""

    def disturb(graph: LiveGraph) -> str:
        map_id = graph.settle()
        graph.processes[node].signal(signal.SIGKILL)
        graph.until(lambda: graph.processes[node].status is not None, "killed")
        meanwhile = ""
        if node != "tracking_node":
            status = graph.track_well()
            assert status.map_id == map_id, "a new map was begun"
            meanwhile = "tracked meanwhile; "
        graph.start(node)
        if node == "map_server_node":
            graph.until(lambda: graph.tries_served() == graph.published(map_id), "served again")
        elif node == "region_manager_node":
            graph.client.regions = None
            graph.until(lambda: bool(graph.client.regions and graph.client.regions.regions), "told")
        elif node == "odometry_node":
            graph.until(lambda: graph.track().odometry_valid, "given odometry again")
        else:
            return meanwhile + _old_map_is_there(graph, map_id)
        return meanwhile + "all of it is back when the node is"

    return disturb


def _old_map_is_there(graph: LiveGraph, map_id: str) -> str:
    versions = graph.published(map_id)
    after = graph.track_well()
    assert after.map_id != map_id, "the map goes on by itself"
    graph.settle()
    kept = MapStore(graph.folder / "maps" / "recent" / map_id).load()
    whole = not kept.warnings and {r.index: r.version for r in kept.regions} == versions
    assert whole, f"the map from before is not whole: {kept.warnings}"
    return "a new map; the one before is kept in recent/, whole"


def stopped(graph: LiveGraph) -> str:
    """Tracking that stands still for three seconds while images come."""
    clocked = Clocked(graph)
    clocked.stream(1.0, 2 * FAST_S)
    tracking = graph.processes["tracking_node"]
    tracking.signal(signal.SIGSTOP)
    clocked.stream(STOPPED_S, 2 * FAST_S)
    tracking.signal(signal.SIGCONT)
    clocked.stream(3.0, 2 * FAST_S)
    since_s = time.monotonic()
    clocked.stream(2.0, 2 * FAST_S)
    last_ns = graph.stamp_ns
    graph.until(lambda: graph.client.last_stamp_ns >= last_ns - 10**9, "up to date")
    oldest_s = clocked.oldest_s(since_s)
    assert oldest_s < STOPPED_S, f"poses are {oldest_s:.1f} s old after the pause"
    status = graph.client.statuses[-1]
    assert "lost on the way" in status.drop_reasons, f"nothing counted: {status.drop_reasons!r}"
    return f"poses at most {oldest_s:.1f} s old three seconds later; {status.drop_reasons}"


@contextmanager
def starved(graph: LiveGraph) -> Iterator[None]:
    """All nodes get a quarter of the time, in slices of a tenth of a second."""
    ended = threading.Event()

    def starve() -> None:
        nodes = list(graph.processes.values())
        while not ended.wait(SHARE * SLICE_S):
            for node in nodes:
                node.signal(signal.SIGSTOP)
            time.sleep((1.0 - SHARE) * SLICE_S)
            for node in nodes:
                node.signal(signal.SIGCONT)

    thread = threading.Thread(target=starve, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def too_slow(graph: LiveGraph) -> str:
    """Thirty pairs a second for a computer with a quarter of its time."""
    clocked = Clocked(graph)
    number = len(graph.client.statuses)
    with starved(graph):
        clocked.stream(6.0, FAST_S)
        since_s = time.monotonic()
        clocked.stream(6.0, FAST_S)
        oldest_s = clocked.oldest_s(since_s)
        graph.reported("tracking_node", "overloaded")
    statuses = graph.client.statuses[number:]
    degraded = [s for s in statuses if s.state == TrackingStatus.DEGRADED and "overl" in s.reason]
    assert degraded, f"never DEGRADED: {statuses[-1].drop_reasons!r}"
    assert all(s.state in (TrackingStatus.OK, TrackingStatus.DEGRADED) for s in statuses)
    longest = max(status.queue_length for status in statuses)
    assert longest <= 30, f"{longest} pairs waited"
    assert oldest_s < 6.0, f"poses are {oldest_s:.1f} s old"
    last = degraded[-1]
    share = last.frames_tracked / max(last.frames_received, 1)
    return (
        f"DEGRADED: {last.reason}; {share:.0%} tracked, at most {longest} waited, poses at most "
        f"{oldest_s:.1f} s old"
    )


def folder_vanishes(graph: LiveGraph) -> str:
    """Somebody removes the map folder."""
    graph.settle()
    maps = graph.folder / "maps"
    graph.until(lambda: any(maps.glob("recent/*/manifest.json")), "kept")
    shutil.rmtree(maps)
    graph.track_well(4)
    graph.settle()
    graph.until(lambda: any(maps.glob("recent/*/manifest.json")), "kept again")
    return "the folder is made again, and the whole map written"


@contextmanager
def small_disk(graph: LiveGraph) -> Iterator[Path]:
    """A file system of 1 MiB below the map folder."""
    folder = graph.folder / "maps"
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode:
        raise SkippedError("a small file system cannot be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=False)


def unwritable(full: bool) -> Disturbance:
    """A disk that is full, or becomes read-only, while the nodes run."""

    def disturb(graph: LiveGraph) -> str:
        graph.settle()
        with small_disk(graph) as folder:
            if full:
                (folder / "other.bin").write_bytes(bytes((1 << 20) - 8192))
            else:
                subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
            graph.track_well(4)
            graph.settle()
            request = SaveMap.Request(name="elsewhere.meslam")
            answer = graph.client.call(SaveMap, topics.SAVE_MAP, request)
            assert answer.result == answer.IO_ERROR, answer.message
            seen = graph.reported("map_server_node", "the map is not kept")
            if full:
                (folder / "other.bin").unlink()
            else:
                subprocess.run(["mount", "-o", "remount,rw", str(folder)], check=True)
            answer = graph.client.call(SaveMap, topics.SAVE_MAP, request)
            assert answer.result == answer.SUCCESS, answer.message
        return f"{answer.message.split(' to ')[0]} afterwards; meanwhile {seen.split(': ')[-1]!r}"

    return disturb


def locked_folder(graph: LiveGraph) -> str:
    """Another system is writing the map of this name."""
    graph.settle()
    folder = graph.folder / "maps" / "shared.meslam"
    request = SaveMap.Request(name=folder.name)
    first = graph.client.call(SaveMap, topics.SAVE_MAP, request)
    assert first.result == first.SUCCESS, first.message
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        answer = graph.client.call(SaveMap, topics.SAVE_MAP, request)
        assert answer.result == answer.IO_ERROR, answer.message
    finally:
        os.close(held)
    second = graph.client.call(SaveMap, topics.SAVE_MAP, request)
    assert second.result == second.SUCCESS, second.message
    return answer.message.split("/")[-1]


FAULTS = (
    *(
        live(
            f"live-kill-{node.removesuffix('_node').replace('_', '-')}",
            f"{node} is killed with SIGKILL and started again",
            expected,
            killed(node),
            ALL,
            same_map=node != "tracking_node",
        )
        for node, expected in {
            "odometry_node": "tracking goes on without, and with it when it is back",
            "map_server_node": "tracking goes on; the map server has the whole map again",
            "region_manager_node": "tracking goes on; the regions are told again",
            "tracking_node": "a new map begins; the one before loads whole",
        }.items()
    ),
    live(
        "live-tracking-stopped",
        "tracking_node is stopped for three seconds while 15 image pairs come a second",
        "afterwards poses are up to date again; what was lost is counted",
        stopped,
        ("tracking_node",),
        alone=True,
    ),
    live(
        "live-quarter-of-the-time",
        "30 image pairs a second, and a quarter of the processor's time for the nodes",
        "pairs are skipped and counted, the state is DEGRADED with the figures, the queue is "
        "bounded, poses are at most 6 s old; then OK again",
        too_slow,
        CAMERA_SIDE,
        alone=True,
    ),
    live(
        "live-folder-vanishes",
        "the map folder is removed while the nodes run",
        "it is made again with the whole map",
        folder_vanishes,
    ),
    live(
        "live-disk-full",
        "the map folder's disk is full while the nodes run",
        "save_map says so, /diagnostics warns, tracking goes on; saved when there is room again",
        unwritable(full=True),
    ),
    live(
        "live-disk-read-only",
        "the map folder's disk becomes read-only while the nodes run",
        "save_map says so, /diagnostics warns, tracking goes on; saved when it is writable again",
        unwritable(full=False),
    ),
    live(
        "live-map-locked",
        "another program holds the map's folder while it is to be saved",
        "IO_ERROR that says so; saved when it is free again",
        locked_folder,
        ("map_server_node", "tracking_node"),
        quick=True,
    ),
)
