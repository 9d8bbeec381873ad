"""The map server while tracking runs: how fast it answers, and whether it is right.

    python benchmarks/map_server.py [--scene room] [--duration S] [--repeats N]

`slam_node` runs with its default parameters, and `bag_player_node` plays a simulated recording
(made on first use, kept in benchmarks/.cache/map_server) at its own pace. From the middle of the
recording on, and again when it has ended, the map server is asked in turn: occupancy of 10,000
points, the mesh of the working region at 4 and at 2 cm, and the occupancy grid of 10 m x 10 m at
5 cm. An answer's time is that from the request in this process to the answer in it. At the end the
occupancy of the 5 cm cells of all space is compared with the true surface: a cell is occupied
when its centre lies behind it, free when it lies before it. Give it a computer that does nothing
else. Writes a table and JSON to docs/benchmarks/map_server.*.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from machine import machine, machine_line
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from simulated import simulated

from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.se3 import Pose, inverse
from meslam_core.simulation.writer import surface_path
from meslam_core.trajectory import read_tum
from meslam_interfaces.msg import OccupancyState, RegionIndex
from meslam_interfaces.srv import GetMesh, GetOccupancyGrid, ListRegions, QueryOccupancy
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import numbers
from meslam_ros.processes import NodeProcess, ros_arguments

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "benchmarks"
CACHE = ROOT / "benchmarks" / ".cache" / "map_server"
LIBRARIES = ("torch", "numpy", "open3d-cpu")
STARTING_S = 90.0
SETTLING_S = 180.0
POINTS = 10_000
GRID_M = 10.0
CELL_M = 0.05
NEAR_M = 0.1
TARGETS_MS = {
    "occupancy of 10,000 points": 50.0,
    "mesh of a region, 4 cm": 1000.0,
    "mesh of a region, 2 cm": 3000.0,
    "grid 10 m x 10 m, 5 cm": 1000.0,
}
TARGET_AGREEMENT = 0.95

Doubles = NDArray[np.float64]


@dataclass
class Timings:
    """How long answers took, by request [ms], and how tracking did meanwhile."""

    ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in TARGETS_MS})
    sizes: dict[str, str] = field(default_factory=dict)
    frames: int = 0
    frames_dropped: int = 0


@dataclass(frozen=True)
class Agreement:
    """Observed cells against the truth.

    Attributes:
        cells, occupied: observed ones, and those of them that are truly occupied.
        agree, near: share that is right, of all and of those up to 10 cm from a surface.
        whole: of those that lie on one side of every surface; one that a surface passes through
            is both.
        free_right, occupied_right: share that is right of the truly free and occupied ones.
    """

    cells: int
    occupied: int
    agree: float
    near: float
    whole: float
    free_right: float
    occupied_right: float

    @classmethod
    def of(cls, states: NDArray[np.int8], truth_m: Doubles) -> Agreement:
        """States (N,) of cells' centres against their signed distances, positive in free space."""
        observed = states != OccupancyState.UNKNOWN
        occupied, truth_m = states[observed] == OccupancyState.OCCUPIED, truth_m[observed]
        truly = truth_m < 0.0
        right = occupied == truly
        return cls(
            cells=len(right),
            occupied=int(truly.sum()),
            agree=float(right.mean()),
            near=float(right[np.abs(truth_m) < NEAR_M].mean()),
            whole=float(right[np.abs(truth_m) > 0.5 * CELL_M].mean()),
            free_right=float(right[~truly].mean()),
            occupied_right=float(right[truly].mean()),
        )


class TrueSurface:
    """The simulator's surface in the map's frame.

    Args:
        recording: with its poses and surface beside it.
    """

    def __init__(self, recording: Path) -> None:
        mesh = o3d.io.read_triangle_mesh(str(surface_path(recording)))
        first = read_tum(recording.with_suffix(".truth.txt")).poses[0]
        T_map_scene: Pose = T_BODY_OPTICAL @ inverse(first)
        mesh.transform(T_map_scene)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))

    def distance_m(self, points: Doubles) -> Doubles:
        """Signed distance (N,) of points (N, 3), positive before the nearest surface [m]."""
        asked = o3d.core.Tensor(points.astype(np.float32))
        found = self._scene.compute_closest_points(asked)
        ahead = points - found["points"].numpy()
        facing = np.einsum("ij,ij->i", ahead, found["primitive_normals"].numpy())
        return np.asarray(np.copysign(np.linalg.norm(ahead, axis=1), facing), np.float64)


class Asker:
    """Asks a running map server, and takes the time."""

    def __init__(self, client: MeslamClient, seed: int) -> None:
        self._client = client
        self._random = np.random.default_rng(seed)

    def ask(self, timings: Timings) -> None:
        """One question of each kind."""
        regions = self._client.call(ListRegions, topics.LIST_REGIONS).regions.regions
        working = self._client.statuses[-1].working_region
        center = self._base()
        for name, request in zip(
            TARGETS_MS,
            (
                self._points(center),
                self._mesh(working, 0.04),
                self._mesh(working, 0.02),
                self._grid(center),
            ),
            strict=True,
        ):
            kind, topic = KINDS[type(request)]
            started = time.perf_counter()
            answer = self._client.call(kind, topic, request)
            timings.ms[name].append((time.perf_counter() - started) * 1e3)
            if answer.result != answer.SUCCESS:
                raise RuntimeError(f"{name}: {answer.message}")
            timings.sizes[name] = f"{answer.message}; {len(regions)} regions"

    def _base(self) -> Doubles:
        newest = max(self._client.poses)
        return np.asarray(self._client.poses[newest][:3, 3], np.float64)

    def _points(self, center: Doubles) -> QueryOccupancy.Request:
        points = self._random.uniform(center - 2.0, center + 2.0, (POINTS, 3))
        return QueryOccupancy.Request(points=numbers("f", points))

    @staticmethod
    def _mesh(region: Any, resolution_m: float) -> GetMesh.Request:
        return GetMesh.Request(resolution_m=resolution_m, regions=[RegionIndex(index=region)])

    @staticmethod
    def _grid(center: Doubles) -> GetOccupancyGrid.Request:
        request = GetOccupancyGrid.Request(resolution_m=CELL_M, use_box=True)
        for corner, sign in ((request.box_min, -0.5), (request.box_max, 0.5)):
            corner.x, corner.y = (center[:2] + sign * GRID_M).tolist()
        return request


KINDS: dict[type, tuple[Any, str]] = {
    QueryOccupancy.Request: (QueryOccupancy, topics.QUERY_OCCUPANCY),
    GetMesh.Request: (GetMesh, topics.GET_MESH),
    GetOccupancyGrid.Request: (GetOccupancyGrid, topics.GET_OCCUPANCY_GRID),
}


def cell_centers(low: Doubles, high: Doubles) -> Doubles:
    """Centres (N, 3) of the cells between two corners (3,) [m]."""
    axes = [
        (np.arange(np.floor(a / CELL_M), np.ceil(b / CELL_M)) + 0.5) * CELL_M
        for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def agreement(client: MeslamClient, surface: TrueSurface) -> Agreement:
    """The occupancy of all cells that the map knows, against the truth."""
    listed = client.call(ListRegions, topics.LIST_REGIONS).regions.regions
    centers = np.array([[r.pose.position.x, r.pose.position.y, r.pose.position.z] for r in listed])
    reach_m = 1.2 * max(region.size_m.x for region in listed)
    states, truths = [], []
    cells = cell_centers(centers.min(axis=0) - reach_m, centers.max(axis=0) + reach_m)
    for part in np.array_split(cells, max(1, len(cells) // 500_000)):
        request = QueryOccupancy.Request(points=numbers("f", part))
        answer = client.call(QueryOccupancy, topics.QUERY_OCCUPANCY, request)
        state = np.array(answer.occupancy, np.int8)
        known = state != OccupancyState.UNKNOWN
        states.append(state[known])
        truths.append(surface.distance_m(part[known]))
    return Agreement.of(np.concatenate(states), np.concatenate(truths))


def measure(recording: Path, duration_s: float, repeats: int) -> dict[str, Any]:
    """Play a recording into all nodes and ask the map server."""
    surface = TrueSurface(recording)
    with tempfile.TemporaryDirectory() as folder, MeslamClient("map_server_benchmark") as client:
        given = {"export_folder": folder, "map_folder": folder, "restore": False}
        slam = NodeProcess("slam_node", ros_arguments(given), log=Path(folder) / "slam.log")
        playing = {"recording": recording, "subscribers": 2, "wait_timeout_s": STARTING_S}
        player = NodeProcess("bag_player_node", ros_arguments(playing), log=Path(folder) / "b.log")
        try:
            live, alone = Timings(), Timings()
            asker = Asker(client, 0)
            _wait(client, lambda: bool(client.poses), STARTING_S, slam)
            began = time.monotonic()
            _wait(client, lambda: time.monotonic() - began > 0.5 * duration_s, STARTING_S, slam)
            before = client.statuses[-1]
            while player.status is None:
                asker.ask(live)
            after = client.statuses[-1]
            live.frames = after.frames_received - before.frames_received
            live.frames_dropped = after.frames_dropped - before.frames_dropped
            _wait(client, lambda: client.settled, SETTLING_S, slam)
            for _ in range(repeats):
                asker.ask(alone)
            return {
                "live": live.__dict__,
                "alone": alone.__dict__,
                "agreement": agreement(client, surface).__dict__,
            }
        finally:
            player.stop()
            slam.stop()


def _wait(
    client: MeslamClient, condition: Callable[[], bool], timeout_s: float, slam: NodeProcess
) -> None:
    if not client.spin_until(condition, timeout_s):
        raise RuntimeError(f"the system does not get on:\n{slam.output()}")


def table(results: dict[str, Any]) -> Table:
    """Times in milliseconds: median and longest, beside the target."""
    shown = Table(
        "request", "target", "tracking: median", "longest", "idle: median", "longest", "answer"
    )
    for name, target in TARGETS_MS.items():
        cells = []
        for when in ("live", "alone"):
            taken = results[when]["ms"][name]
            cells += [f"{np.median(taken):.0f}", f"{max(taken):.0f}"] if taken else ["-", "-"]
        shown.add_row(name, f"{target:.0f}", *cells, results["alone"]["sizes"].get(name, ""))
    return shown


def summary(results: dict[str, Any]) -> str:
    """What the table does not say, as lines."""
    found, live = Agreement(**results["agreement"]), results["live"]
    return (
        f"occupancy of {found.cells} observed cells of {CELL_M * 100:.0f} cm: "
        f"{found.agree:.1%} as the simulator has it (target {TARGET_AGREEMENT:.0%}); of those that "
        f"no surface passes through {found.whole:.1%}; of the truly "
        f"free ones {found.free_right:.1%}, of the {found.occupied} occupied ones "
        f"{found.occupied_right:.1%}; within {NEAR_M * 100:.0f} cm of a surface {found.near:.1%}\n"
        f"while asked, tracking took {live['frames']} frames and dropped {live['frames_dropped']}"
    )


def main() -> None:
    """Run, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="room")
    parser.add_argument("--duration", type=float, default=40.0, help="of the recording [s]")
    parser.add_argument("--repeats", type=int, default=5, help="of the questions when it has ended")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    name = f"{options.scene}_{options.duration:.0f}"
    recording = simulated(
        options.scene, CACHE / f"{name}.mcap", "--duration", str(options.duration)
    )
    results = measure(recording, options.duration, options.repeats)
    console = Console(width=160, markup=False, record=True)
    console.print(machine_line(machine(LIBRARIES)))
    console.print(f"meslam simulate {options.scene} --duration {options.duration:g}")
    console.print(table(results))
    console.print(summary(results))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "map_server.txt").write_text(console.export_text())
    written = {"machine": machine(LIBRARIES), "recording": name, "results": results}
    (options.out / "map_server.json").write_text(json.dumps(written, indent=2) + "\n")


if __name__ == "__main__":
    main()
