"""The main job with the real nodes: a recording in, a trajectory, a map and a mesh out.

    make demo                     a simulated room, made on the first run
    make demo RECORDING=path      a recording of your own

Starts `slam_node`, serves a page in the browser that shows the map while it grows, and plays the
recording through `bag_player_node` over real DDS, calls the services that export and save the map,
and writes trajectories, map, mesh, report and pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from demo_report import (
    ERROR_PICTURE,
    MESH,
    MESH_RESOLUTION_M,
    PATH_PICTURE,
    VIEWS_PICTURE,
    Live,
    evaluate,
    find_truth,
    origin,
    summarise,
    write_page,
)
from demo_viewer import live_page
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from meslam_core.errors import MeslamError, TrackingLostError
from meslam_core.recordings import open_recording
from meslam_core.results import MAP, ResultFolder
from meslam_core.simulation.simulator import simulate
from meslam_core.simulation.writer import surface_path, truth_path, write_simulation
from meslam_core.trajectory import read_tum
from meslam_interfaces.srv import ExportMap, ListRegions, SaveMap
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import stamp_ns
from meslam_ros.domains import free_domain
from meslam_ros.node_settings import PlayerSettings
from meslam_ros.processes import NodeProcess, ros_arguments

ROOT = Path(__file__).resolve().parents[1]
SCENE, SEED, DURATION_S = "room", 1, 20.0
NODES_LOG, PLAYER_LOG = "nodes.log", "player.log"
STARTING_S, FINISHING_S, SERVICE_S, SILENCE_S = 90.0, 120.0, 300.0, 120.0
IMAGE_SUBSCRIBERS = 2
# So that who watches sees something new every second.
MODEL_PERIOD_S = 0.9
LOG_LINES = 15


class DemoError(MeslamError):
    """The demo cannot go on."""


def main() -> int:
    """Run the demo; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path, help="any recording; default: simulated")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder of the results")
    parser.add_argument("--truth", type=Path, help="poses in TUM format to compare with")
    parser.add_argument("--frames", type=int, default=0, help="play only so many image pairs")
    parser.add_argument(
        "--port", type=int, default=8080, help="of the live page; a negative one for no page"
    )
    options = parser.parse_args()
    console = Console()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        recording = options.recording or simulated(console)
        _own_domain()
        run(console, recording, options.out, options.truth, options.frames, options.port)
    except TrackingLostError as error:
        console.print(f"[bold red]demo failed:[/] {error}", highlight=False)
        return 3
    except (MeslamError, TimeoutError) as error:
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


def run(
    console: Console, path: Path, out: Path, truth_file: Path | None, frames: int, port: int
) -> None:
    """Map one recording with the nodes and leave the results in `out`."""
    started = time.monotonic()
    recording = open_recording(path)
    count = min(frames or len(recording), len(recording))
    truth_file = find_truth(path, truth_file)
    truth = None if truth_file is None else read_tum(truth_file)
    with ResultFolder(out) as results, live_page(console, port):
        staging = results.incomplete("")
        live = map_live(console, path.resolve(), count, staging)
        with console.status("evaluating"):
            report = evaluate(recording, path, truth, live, staging)
        report["wall_s"] = time.monotonic() - started
        report |= origin(recording, truth_file, count)
        results.write_report(report)
        for name in (MESH, PATH_PICTURE, ERROR_PICTURE, VIEWS_PICTURE, NODES_LOG, PLAYER_LOG):
            if (staging / name).exists():
                (staging / name).replace(out / name)
            else:
                (out / name).unlink(missing_ok=True)
        results.publish()
    recording.close()
    with _progress(console) as progress:
        task = progress.add_task("writing the report", total=None)
        write_page(out, lambda done, total: progress.update(task, completed=done, total=total))
    summarise(console, path, out, report)
    console.print(
        f"see it again in the browser: meslam view {out}", highlight=False, soft_wrap=True
    )


def map_live(console: Console, path: Path, count: int, staging: Path) -> Live:
    """Start the nodes, play the recording, ask for the map."""
    given = {
        "export_folder": staging,
        "map_folder": staging,
        "model_period_s": MODEL_PERIOD_S,
    }
    playing = {
        "recording": path,
        "rate": 0.0,
        "frames": count,
        "subscribers": IMAGE_SUBSCRIBERS,
    }
    with (
        MeslamClient("meslam_demo") as client,
        _node("slam_node", ros_arguments(given), staging / NODES_LOG) as slam,
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
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_domain(os.getpid())))


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
