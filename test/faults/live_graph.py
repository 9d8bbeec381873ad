"""All nodes as processes of their own, a camera, and what may be asked of them after a fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from data.ros_camera import BASE_FRAME, CameraDriver, Messages
from data.textured_room import PERIOD_NS, frame_at, path
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher

from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import inverse
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_interfaces.srv import ListRegions
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, to_pose, to_stamp
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM, latched

NODES = ("map_server_node", "region_manager_node", "odometry_node", "tracking_node")
ANSWER_S = 90.0
SLICE_S = 0.5
RESEND_S, RESENDS = 5.0, 24
THERE = path(8, step_m=0.008, step_deg=0.4)
POSES = [*THERE, *THERE[-2:0:-1]]
QUICK: dict[str, Any] = {
    "mapping.first_iterations": 150,
    "mapping.iterations": 8,
    "mapping.keyframe_iterations": 10,
    "mapping.final_iterations": 20,
    "keyframes.rays": 2048,
    "model_period_s": 0.1,
    "idle_s": 0.3,
    "keep_period_s": 0.1,
    "transform_timeout_s": 1.0,
}

STREAM_LATCHED = latched(50)
Change = Callable[[Messages], None]


class LiveGraph:
    """Running nodes and a camera that looks about a room, one image pair after the other.

    Args:
        client: somebody who uses the system.
        folder: for maps, exports and logs.
        nodes: to start.
        mounted: whether /tf_static connects the camera to its base.
        parameters: of all nodes.
    """

    def __init__(
        self,
        client: MeslamClient,
        folder: Path,
        nodes: tuple[str, ...] = NODES,
        mounted: bool = True,
        **parameters: Any,
    ) -> None:
        self.client = client
        self.folder = folder
        self.camera = CameraDriver(client.node, mounted=mounted)
        self.models: dict[tuple[str, tuple[int, ...]], RegionModel] = {}
        self.processes: dict[str, NodeProcess] = {}
        self.reports: dict[str, DiagnosticStatus] = {}
        self.stamp_ns = NANOSECONDS
        self.map_id = ""
        self._deaf = False
        self._views = [frame_at(pose) for pose in POSES]
        self._place = 0
        self._parameters = {
            **QUICK,
            "map_folder": folder / "maps",
            "export_folder": folder / "exports",
            **{name.replace("__", "."): value for name, value in parameters.items()},
        }
        subscribe = client.node.create_subscription
        subscribe(RegionModel, topics.REGION_MODELS, self._take_model, latched(100))
        subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._take_reports, STREAM)
        for node in nodes:
            self.start(node)

    def start(self, node: str, name: str = "", **parameters: Any) -> NodeProcess:
        """Start a node, with parameters of its own besides those of all."""
        name = name or node
        extra = ["-r", f"__node:={name}"] if name != node else []
        arguments = ros_arguments({**self._parameters, **parameters}, extra)
        process = NodeProcess(node, arguments, log=self.folder / f"{name}.log")
        self.processes[name] = process
        return process

    def stop(self) -> list[int]:
        """End all nodes; their exit statuses."""
        return [process.stop() for process in self.processes.values()]

    def until(self, condition: Callable[[], bool], what: str, timeout_s: float = ANSWER_S) -> None:
        """Wait for something, or fail with the nodes' logs."""
        assert self.comes_true(condition, timeout_s), f"never {what}\n{self.logs()}"

    def comes_true(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Listen until something holds; time in which this process was stopped does not count."""
        return any(
            self.client.spin_until(condition, SLICE_S) for _ in range(round(timeout_s / SLICE_S))
        )

    @property
    def next_ns(self) -> int:
        """Stamp of the next view [ns]."""
        return self.stamp_ns + PERIOD_NS

    def odometry(self) -> Odometry:
        """True odometry of the next view."""
        moved = inverse(POSES[0]) @ POSES[(self._place + 1) % len(POSES)]
        message = Odometry(child_frame_id=BASE_FRAME)
        message.header.frame_id = "odom"
        message.header.stamp = to_stamp(self.next_ns)
        message.pose.pose = to_pose(T_BODY_OPTICAL @ moved @ inverse(T_BODY_OPTICAL))
        return message

    def wait(self, seconds: float) -> None:
        """Listen for a while [s]."""
        self.client.spin_until(lambda: False, seconds)

    def view(self) -> RgbdFrame:
        """The next view of the room, a frame's time later."""
        self._place = (self._place + 1) % len(POSES)
        self.stamp_ns += PERIOD_NS
        return replace(self._views[self._place], stamp_ns=self.stamp_ns)

    def send(self, change: Change = lambda messages: None) -> int:
        """Send the next view, changed as a fault wants it; its stamp [ns]."""
        # What came until now may have been somebody else's.
        self._deaf = False
        return self.camera.send(self.view(), change)

    def track(self, change: Change = lambda messages: None) -> TrackingStatus:
        """Send the next view, again while nobody listens; tracking's answer."""
        before = len(self.client.statuses)
        for _ in range(RESENDS):
            self.send(change)
            if self.comes_true(lambda: len(self.client.statuses) > before, RESEND_S):
                return self.client.statuses[-1]
            if self.processes["tracking_node"].status is not None:
                break
        raise AssertionError(f"tracking does not answer\n{self.logs()}")

    def track_well(self, count: int = 2, tries: int = 120) -> TrackingStatus:
        """Send good views until so many in a row are tracked well; the last answer."""
        row = 0
        for _ in range(tries):
            status = self.track()
            row = row + 1 if status.state == TrackingStatus.OK else 0
            if row == count:
                return status
            self.wait(PERIOD_NS / NANOSECONDS)
        raise AssertionError(
            f"not tracked well again: state {status.state}, {status.reason!r}\n{self.logs()}"
        )

    def served(self, timeout_s: float = ANSWER_S) -> dict[tuple[int, ...], int]:
        """The map server's regions and their versions."""
        answer = self.client.call(ListRegions, topics.LIST_REGIONS, timeout_s=timeout_s)
        regions = answer.regions
        self.map_id = regions.map_id
        return {tuple(region.index): region.version for region in regions.regions}

    def tries_served(self) -> dict[tuple[int, ...], int]:
        """`served`, of a map server that may not be there yet."""
        try:
            return self.served(timeout_s=5.0)
        except TimeoutError:
            return {}

    def settle(self) -> str:
        """Wait until the map is refined, published and served; its identity."""
        self.until(lambda: self.client.settled, "settled")
        map_id = self.client.statuses[-1].map_id
        self.until(lambda: self.served() == self.published(map_id), "served")
        assert self.map_id == map_id
        return map_id

    def published(self, map_id: str) -> dict[tuple[int, ...], int]:
        """A map's regions as tracking published them, and their versions."""
        return {index: m.version for (of, index), m in self.models.items() if of == map_id}

    @contextmanager
    def foreign(self, message: type, topic: str, nodes: int = 1) -> Iterator[Publisher]:
        """A publisher that is none of the system's, as soon as so many nodes hear it."""
        publisher = self.client.node.create_publisher(message, topic, STREAM_LATCHED)
        self._deaf = True
        try:
            own = message is RegionModel
            self.until(lambda: publisher.get_subscription_count() >= nodes + own, "heard")
            yield publisher
        finally:
            self.client.node.destroy_publisher(publisher)

    def reported(self, node: str, *words: str) -> str:
        """Wait until a node's diagnosis has all these words; the diagnosis."""

        def text() -> str:
            status = self.reports.get(node)
            if status is None:
                return ""
            return " ".join([status.message, *(f"{v.key}={v.value}" for v in status.values)])

        self.until(lambda: all(word in text() for word in words), f"diagnosed {words} at {node}")
        return self.reports[node].message

    def logged(self, node: str, *words: str) -> None:
        """Wait until a node has logged all these words."""
        self.until(
            lambda: all(word in self.processes[node].output() for word in words),
            f"logged {words} by {node}",
        )

    def assert_alive(self) -> None:
        """No node has ended, and none has met an exception that it did not expect."""
        dead = {name: p.status for name, p in self.processes.items() if p.status is not None}
        assert not dead, f"ended: {dead}\n{self.logs()}"
        assert "Traceback" not in self.logs(), self.logs()

    def logs(self) -> str:
        """What all nodes have logged."""
        return "\n".join(f"--- {name}\n{p.output()}" for name, p in self.processes.items())

    def _take_model(self, model: RegionModel) -> None:
        if not self._deaf:
            self.models[model.map_id, tuple(map(int, model.index))] = model

    def _take_reports(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.reports[status.name.split(":")[-1].strip()] = status


@contextmanager
def live_graph(folder: Path, **options: Any) -> Iterator[LiveGraph]:
    """A running graph that is tracked well; its nodes end with the context."""
    folder.mkdir(parents=True, exist_ok=True)
    with MeslamClient("faults") as client:
        graph = LiveGraph(client, folder, **options)
        try:
            yield graph
        finally:
            graph.stop()
