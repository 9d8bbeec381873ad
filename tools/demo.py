"""The main job with the real nodes: a recording in, a trajectory, a map and a mesh out.

    make demo                     a simulated room, made on the first run
    make demo RECORDING=path      a recording of your own

Starts `slam_node` and plays the recording through `bag_player_node` over real DDS, calls the
services that export and save the map, and writes trajectories, map, mesh, report and pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from meslam_core.errors import MeslamError, TrackingLostError
from meslam_core.evaluation.plots import (
    ViewPair,
    plot_error_over_time,
    plot_path,
    plot_path_alone,
    plot_views,
)
from meslam_core.evaluation.reconstruction import observed_surface, surface_error
from meslam_core.evaluation.report import truth_entries
from meslam_core.evaluation.trajectory_error import AbsoluteError, absolute_error
from meslam_core.evaluation.views import MeshRenderer
from meslam_core.recordings import open_recording
from meslam_core.recordings.recording import Recording
from meslam_core.results import MAP, ONLINE_TRAJECTORY, TRAJECTORY, ResultFolder
from meslam_core.run_report import run_environment
from meslam_core.simulation.simulator import simulate
from meslam_core.simulation.writer import surface_path, truth_path, write_simulation
from meslam_core.trajectory import Trajectory, read_tum, write_tum
from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import ExportMap, ListRegions, SaveMap
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import stamp_ns
from meslam_ros.node_settings import PlayerSettings
from meslam_ros.processes import NodeProcess, ros_arguments

ROOT = Path(__file__).resolve().parents[1]
SCENE, SEED, DURATION_S = "room", 1, 20.0
MESH, PATH_PICTURE, ERROR_PICTURE, VIEWS_PICTURE = "mesh.ply", "path.png", "error.png", "views.png"
NODES_LOG, PLAYER_LOG = "nodes.log", "player.log"
MESH_RESOLUTION_M = 0.02
VIEWS = 3
STARTING_S, FINISHING_S, SERVICE_S, SILENCE_S = 90.0, 120.0, 300.0, 120.0
IMAGE_SUBSCRIBERS = 2
LOG_LINES = 15
HAS_POSE = (TrackingStatus.OK, TrackingStatus.DEGRADED)


class DemoError(MeslamError):
    """The demo cannot go on."""


@dataclass(frozen=True)
class Live:
    """What came out of the running nodes."""

    refined: Trajectory
    online: Trajectory
    statuses: list[TrackingStatus]
    export: ExportMap.Response
    saved: SaveMap.Response
    observed_volume_m3: float
    playing_s: float


def main() -> int:
    """Run the demo; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path, help="any recording; default: simulated")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder of the results")
    parser.add_argument("--truth", type=Path, help="poses in TUM format to compare with")
    parser.add_argument("--frames", type=int, default=0, help="play only so many image pairs")
    options = parser.parse_args()
    console = Console()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        recording = options.recording or simulated(console)
        run(console, recording, options.out, options.truth, options.frames)
    except TrackingLostError as error:
        console.print(f"[bold red]demo failed:[/] {error}", highlight=False)
        return 3
    except MeslamError as error:
        console.print(f"[bold red]demo failed:[/] {error}", highlight=False)
        return 2
    except KeyboardInterrupt:
        console.print("interrupted")
        return 130
    return 0


def simulated(console: Console) -> Path:
    """The simulated recording, made where it is not there yet."""
    path = ROOT / "bags" / f"{SCENE}_{DURATION_S:.0f}s_seed{SEED}.mcap"
    if path.exists() and truth_path(path).exists() and surface_path(path).exists():
        console.print(f"simulated recording: {path}", highlight=False)
        return path
    with _progress(console) as progress:
        task = progress.add_task("simulating a room and a camera", total=None)
        write_simulation(
            simulate(SCENE, DURATION_S, SEED),
            path,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    return path


def run(console: Console, path: Path, out: Path, truth_file: Path | None, frames: int) -> None:
    """Map one recording with the nodes and leave the results in `out`."""
    started = time.monotonic()
    recording = open_recording(path)
    count = min(frames or len(recording), len(recording))
    truth = _truth(path, truth_file)
    with ResultFolder(out) as results:
        staging = results.incomplete("")
        live = map_live(console, path.resolve(), count, staging)
        with console.status("evaluating"):
            report = evaluate(recording, path, truth, live, staging)
        report["wall_s"] = time.monotonic() - started
        results.write_report(report)
        for name in (MESH, PATH_PICTURE, ERROR_PICTURE, VIEWS_PICTURE, NODES_LOG, PLAYER_LOG):
            if (staging / name).exists():
                (staging / name).replace(out / name)
            else:
                (out / name).unlink(missing_ok=True)
        results.publish()
    recording.close()
    summarise(console, path, out, report)


def map_live(console: Console, path: Path, count: int, staging: Path) -> Live:
    """Start the nodes, play the recording, ask for the map."""
    _own_domain()
    folders = {"export_folder": staging, "map_folder": staging}
    playing = {
        "recording": path,
        "rate": 0.0,
        "frames": count,
        "subscribers": IMAGE_SUBSCRIBERS,
    }
    with (
        MeslamClient("meslam_demo") as client,
        _node("slam_node", ros_arguments(folders), staging / NODES_LOG) as slam,
    ):
        with console.status("starting the nodes"):
            _wait(client, slam, lambda: _all_there(client), STARTING_S, "the nodes do not start")
        with _node("bag_player_node", ros_arguments(playing), staging / PLAYER_LOG) as player:
            started = time.monotonic()
            _follow(console, client, slam, player, count)
            playing_s = time.monotonic() - started
        with console.status("exporting the map"):
            return _collect(client, slam, playing_s)


def _all_there(client: MeslamClient) -> bool:
    return (
        client.node.count_publishers(client.node.resolve_topic_name(topics.STATUS)) > 0
        and client.node.count_publishers(client.node.resolve_topic_name(topics.ODOMETRY)) > 0
        and client.node.count_publishers(client.node.resolve_topic_name(topics.REGIONS)) > 0
    )


def _follow(
    console: Console, client: MeslamClient, slam: NodeProcess, player: NodeProcess, count: int
) -> None:
    """Show progress until the player has ended."""
    with _progress(console) as progress:
        task = progress.add_task("tracking and mapping", total=count)
        heard, seen = time.monotonic(), 0
        while player.status is None:
            client.spin_until(lambda: player.status is not None, 0.3)
            if len(client.statuses) > seen:
                heard, seen = time.monotonic(), len(client.statuses)
            progress.update(task, completed=seen)
            _check_alive(slam)
            if time.monotonic() - heard > SILENCE_S:
                raise DemoError(
                    f"nothing has been tracked for {SILENCE_S:.0f} s\n{_tail(slam)}{_tail(player)}"
                )
        client.spin_until(lambda: len(client.statuses) >= count, 2.0)
        progress.update(task, completed=len(client.statuses))
    if player.status:
        raise DemoError(f"the player ended with status {player.status}\n{_tail(player)}")


def _collect(client: MeslamClient, slam: NodeProcess, playing_s: float) -> Live:
    """Wait for the final path and map, and have the map exported and saved."""
    last_ns = client.last_stamp_ns
    if not client.poses:
        raise TrackingLostError(
            f"not one of {len(client.statuses)} frames got a pose\n{_tail(slam)}"
        )
    listed: list[ListRegions.Response] = []

    def map_is_final() -> bool:
        if not client.settled:
            return False
        listed.append(client.call(ListRegions, topics.LIST_REGIONS, timeout_s=SERVICE_S))
        # The models of a settled map are on their way to the server; two equal answers are final.
        versions = [[region.version for region in each.regions.regions] for each in listed[-2:]]
        same = len(versions) == 2 and versions[0] == versions[1]
        return same and stamp_ns(listed[-1].regions.header.stamp) >= last_ns

    _wait(client, slam, map_is_final, FINISHING_S, "the map does not arrive at the map server")
    _wait(client, slam, lambda: client.path_stamp_ns >= last_ns, FINISHING_S, "no final path comes")
    export = client.call(
        ExportMap,
        topics.EXPORT_MAP,
        ExportMap.Request(path=MESH, resolution_m=MESH_RESOLUTION_M),
        SERVICE_S,
    )
    saved = client.call(SaveMap, topics.SAVE_MAP, SaveMap.Request(name=MAP), SERVICE_S)
    for answer in (export, saved):
        if answer.result != answer.SUCCESS:
            raise DemoError(f"the map server refuses: {answer.message}")
    defaults = PlayerSettings()
    T_base_camera = client.mount(defaults.base_frame, defaults.optical_frame)
    assert T_base_camera is not None
    regions = listed[-1].regions.regions
    return Live(
        refined=client.refined_trajectory(T_base_camera),
        online=client.online_trajectory(T_base_camera),
        statuses=client.statuses,
        export=export,
        saved=saved,
        observed_volume_m3=sum(region.observed_volume_m3 for region in regions),
        playing_s=playing_s,
    )


def evaluate(
    recording: Recording, path: Path, truth: Trajectory | None, live: Live, staging: Path
) -> dict[str, Any]:
    """Write trajectories and pictures; the content of the report."""
    write_tum(staging / TRAJECTORY, live.refined)
    write_tum(staging / ONLINE_TRAJECTORY, live.online)
    mesh = o3d.io.read_triangle_mesh(str(staging / MESH))
    report = _report(live)
    error = None
    if truth is not None:
        report |= truth_entries(live.refined, live.online, truth)
        error = absolute_error(live.refined, truth)
        errors = {"refined": error, "online": absolute_error(live.online, truth)}
        plot_path(staging / PATH_PICTURE, error, path.name)
        plot_error_over_time(staging / ERROR_PICTURE, errors, path.name)
    else:
        plot_path_alone(staging / PATH_PICTURE, live.refined, path.name)
    _picture_views(recording, live, mesh, staging / VIEWS_PICTURE, path.name)
    if error is not None and truth is not None and surface_path(path).exists():
        report["surface"] = _surface(recording, path, truth, error, mesh)
    return report


def _report(live: Live) -> dict[str, Any]:
    statuses, last = live.statuses, live.statuses[-1]
    tracked = sum(status.state in HAS_POSE for status in statuses)
    stamps = [stamp_ns(status.header.stamp) for status in statuses]
    spread = {
        name: {"median": float(np.median(values)), "p95": float(np.percentile(values, 95))}
        for name, values in (
            ("tracking", [status.tracking_ms for status in statuses]),
            ("mapping", [status.mapping_ms for status in statuses]),
            ("latency", [1e3 * status.latency_s for status in statuses]),
        )
    }
    return {
        "frames": len(statuses),
        "frames_tracked": tracked,
        "frames_lost": len(statuses) - tracked,
        "frames_dropped": last.frames_dropped,
        "keyframes": last.keyframes,
        "regions": live.saved.regions,
        "sensor_s": (stamps[-1] - stamps[0]) * 1e-9,
        "playing_s": live.playing_s,
        "fps": len(statuses) / live.playing_s,
        "map_bytes": live.saved.bytes,
        "observed_volume_m3": live.observed_volume_m3,
        "stage_ms": spread,
        "mesh": {
            "resolution_m": MESH_RESOLUTION_M,
            "vertices": live.export.vertices,
            "triangles": live.export.triangles,
            "bytes": live.export.bytes,
        },
        **run_environment(),
    }


def _picture_views(
    recording: Recording, live: Live, mesh: o3d.geometry.TriangleMesh, target: Path, title: str
) -> None:
    """Camera images beside the mesh from the same poses, evenly over the recording."""
    count = len(live.refined)
    chosen = np.linspace(0.1 * count, 0.9 * (count - 1), min(VIEWS, count)).astype(int)
    wanted = {int(live.refined.stamps_ns[i]): live.refined.poses[i] for i in chosen}
    renderer = MeshRenderer(mesh)
    pairs = []
    first_ns: int | None = None
    for frame in recording.frames():
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        if frame.stamp_ns in wanted:
            rendered, depth_m = renderer.render(frame.camera, wanted.pop(frame.stamp_ns))
            label = f"{(frame.stamp_ns - first_ns) * 1e-9:.1f} s"
            pairs.append(ViewPair(label, frame.color, rendered, frame.depth_m, depth_m))
        if not wanted:
            break
    plot_views(target, pairs, title)


def _surface(
    recording: Recording,
    path: Path,
    truth: Trajectory,
    error: AbsoluteError,
    mesh: o3d.geometry.TriangleMesh,
) -> dict[str, float]:
    """Accuracy and completion of the mesh against the simulator's surface."""
    surface = o3d.io.read_triangle_mesh(str(surface_path(path)))
    seen = np.isin(truth.stamps_ns, error.truth.stamps_ns)
    observed = observed_surface(surface, recording.camera, truth.subset(np.flatnonzero(seen)))
    return surface_error(mesh, surface, observed, T_truth_map=error.mounting.T_truth_map).to_dict()


def _truth(path: Path, given: Path | None) -> Trajectory | None:
    """True poses: those given, the simulator's, or a TUM folder's."""
    for candidate in (given, truth_path(path), path / "groundtruth.txt"):
        if candidate is not None and (candidate == given or candidate.is_file()):
            return read_tum(candidate)
    return None


def summarise(console: Console, path: Path, out: Path, report: dict[str, Any]) -> None:
    """A short summary for people."""
    table = Table(title=f"{path.name}", show_header=False, title_justify="left")
    rows = [
        ("frames with a pose", f"{report['frames_tracked']} of {report['frames']}"),
        ("speed", f"{report['fps']:.1f} frames a second"),
        (
            "map",
            f"{report['regions']} regions, {report['map_bytes'] / 1000:.0f} kB, "
            f"{report['observed_volume_m3']:.1f} m³ seen",
        ),
        ("mesh", f"{report['mesh']['triangles']} triangles"),
    ]
    if "ate_rmse_m" in report:
        rows.append(("trajectory error (ATE RMSE)", f"{100 * report['ate_rmse_m']:.1f} cm"))
        rows.append(("as known live", f"{100 * report['ate_online_rmse_m']:.1f} cm"))
    if "surface" in report:
        surface = report["surface"]
        rows.append(
            ("mesh to true surface, median", f"{100 * surface['accuracy_median_m']:.1f} cm")
        )
        rows.append(("true surface within 5 cm", f"{surface['completion_ratio']:.0%}"))
    rows.append(("time for everything", f"{report['wall_s']:.0f} s"))
    for row in rows:
        table.add_row(*row)
    console.print(table)
    names = sorted(entry.name for entry in out.iterdir() if not entry.name.startswith("."))
    console.print(f"results in {out}: {', '.join(names)}", highlight=False, soft_wrap=True)


@contextlib.contextmanager
def _node(name: str, arguments: list[str], log: Path) -> Iterator[NodeProcess]:
    """A node that ends with the block."""
    process = NodeProcess(name, arguments, log=log)
    try:
        yield process
    finally:
        process.stop()


def _wait(
    client: MeslamClient, slam: NodeProcess, condition: Any, timeout_s: float, failure: str
) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        client.spin_until(lambda: False, 0.2)
        _check_alive(slam)
        if time.monotonic() > deadline:
            raise DemoError(f"{failure} within {timeout_s:.0f} s\n{_tail(slam)}")


def _check_alive(slam: NodeProcess) -> None:
    if slam.status is not None:
        raise DemoError(f"the nodes ended with status {slam.status}\n{_tail(slam)}")


def _tail(process: NodeProcess) -> str:
    """The end of a process's log."""
    lines = process.output().splitlines()[-LOG_LINES:]
    return "".join(f"  {process.name}: {line}\n" for line in lines)


def _own_domain() -> None:
    """Keep to this computer, and out of the way of other systems on it."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )


if __name__ == "__main__":
    sys.exit(main())
