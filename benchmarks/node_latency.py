"""The nodes in real time: frames with a pose, latency and accuracy, in processes of their own.

    MESLAM_DATA=folder python benchmarks/node_latency.py [--runs N]

`slam_node` runs with its default parameters, and `bag_player_node` plays `tum_fr1_xyz`, converted
to mcap, at 15 fps: six processes on this computer, and this program as the seventh, which listens
to poses alone. Latency of a frame: from the publication of its camera_info, which the player sends
before its images, to the arrival of its `/meslam/pose` here, both by the computer's clock. ATE
online of the poses as they came, beside that of `meslam run` on the same frames. Processor time and
memory of each process are the kernel's. Give it a computer that does nothing else. Writes a table,
JSON and a plot to docs/benchmarks/node_latency.*.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from geometry_msgs.msg import PoseStamped
from machine import machine, machine_line, memory_mb
from rich.console import Console
from rich.table import Table
from sensor_msgs.msg import CameraInfo

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.pipeline import RunOptions, run
from meslam_core.recordings import convert, open_recording
from meslam_core.trajectory import Trajectory, read_tum
from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import stamp_ns
from meslam_ros.domains import free_domain
from meslam_ros.node_settings import PlayerSettings
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM
from meslam_ros.slam_node import NODES

mpl.use("Agg")
from matplotlib import pyplot as plt

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "benchmarks"
CACHE = ROOT / "benchmarks" / ".cache" / "node_latency"
LIBRARIES = ("torch", "numpy")
RECORDING = "tum_fr1_xyz"
FPS = 15.0
STARTING_S = 60.0
FINISHING_S = 30.0
IMAGE_SUBSCRIBERS = 2
MILLISECONDS = 1e-6
TARGETS = {"share": 0.98, "median_ms": 100.0, "p95_ms": 200.0, "ate_difference_m": 0.005}
NOT_OK = (TrackingStatus.DEGRADED, TrackingStatus.LOST, TrackingStatus.RELOCALISING)


@dataclass(frozen=True)
class Load:
    """What a process took.

    Attributes:
        cpu_s: processor time while the recording was played [s].
        peak_mb: largest resident set [MB].
    """

    cpu_s: float
    peak_mb: float


@dataclass(frozen=True)
class LiveResult:
    """One recording played into the nodes.

    Attributes:
        frames: played.
        poses: that came.
        not_ok: frames that were degraded, lost or sought.
        dropped: as the last status counts them, with reasons.
        latencies_ms: from publication to the pose's arrival, one a pose [ms].
        ate_m: RMSE of the poses as they came [m].
        played_s: from the first to the last publication [s].
        loads: by process.
    """

    frames: int
    poses: int
    not_ok: int
    dropped: str
    latencies_ms: list[float]
    ate_m: float
    played_s: float
    loads: dict[str, Load]

    @property
    def share(self) -> float:
        """Of the frames, those with a pose."""
        return self.poses / self.frames

    def percentile(self, percent: float) -> float:
        """Of the latencies [ms]; a frame without a pose counts as infinitely late."""
        late = self.latencies_ms + [np.inf] * (self.frames - self.poses)
        return float(np.percentile(late, percent, method="higher"))


class Stopwatch:
    """Notes when frames were published and when their poses came, by the computer's clock [ns]."""

    def __init__(self, client: MeslamClient) -> None:
        self.published: dict[int, int] = {}
        self.arrived: dict[int, int] = {}
        subscribe = client.node.create_subscription
        subscribe(CameraInfo, topics.COLOR_INFO, self._take_info, STREAM)
        subscribe(PoseStamped, topics.POSE, self._take_pose, STREAM)

    def latencies_ms(self) -> list[float]:
        """Of all frames that got a pose, in their order [ms]."""
        return [
            (self.arrived[stamp] - self.published[stamp]) * MILLISECONDS
            for stamp in sorted(self.published)
            if stamp in self.arrived
        ]

    @property
    def played_s(self) -> float:
        """From the first to the last publication [s]."""
        return (max(self.published.values()) - min(self.published.values())) * 1e-9

    def _take_info(self, message: CameraInfo, info: Mapping[str, Any]) -> None:
        self.published.setdefault(stamp_ns(message.header.stamp), info["source_timestamp"])

    def _take_pose(self, message: PoseStamped, info: Mapping[str, Any]) -> None:
        self.arrived.setdefault(stamp_ns(message.header.stamp), info["received_timestamp"])


def play(mcap: Path, truth: Trajectory, folder: Path, frames: int) -> LiveResult:
    """Play a recording in real time into all nodes."""
    with closing(open_recording(mcap)) as recording:
        stamps = recording.stamps_ns
    rate = FPS / ((len(stamps) - 1) / (float(stamps[-1] - stamps[0]) * 1e-9))
    count = min(frames or len(stamps), len(stamps))
    folders = {"export_folder": folder, "map_folder": folder}
    playing = {
        "recording": mcap,
        "rate": rate,
        "frames": count,
        # This program hears camera_info; only the nodes hear images.
        "subscribers": IMAGE_SUBSCRIBERS,
        "wait_timeout_s": STARTING_S,
    }
    slam = NodeProcess("slam_node", ros_arguments(folders), log=folder / "slam_node.log")
    player = None
    try:
        with MeslamClient("node_latency") as client:
            watch = Stopwatch(client)
            ready = client.spin_until(lambda: _ready(client), STARTING_S)
            pids = processes_of(slam.pid)
            before = {name: cpu_s(pid) for name, pid in pids.items()}
            player = NodeProcess(
                "bag_player_node", ros_arguments(playing), log=folder / "player.log"
            )
            limit_s = STARTING_S + 2.0 * count / FPS
            played = ready and client.spin_until(lambda: player.status is not None, limit_s)
            if not played or player.status:
                raise SystemExit(f"the nodes do not run:\n{slam.output()}\n{player.output()}")
            client.spin_until(lambda: client.settled, FINISHING_S)
            loads = {
                name: Load(cpu_s(pid) - before[name], memory_mb(pid)[1])
                for name, pid in pids.items()
            }
            defaults = PlayerSettings()
            T_base_camera = client.mount(defaults.base_frame, defaults.optical_frame)
            assert T_base_camera is not None
            latencies = watch.latencies_ms()
            return LiveResult(
                frames=count,
                poses=len(latencies),
                not_ok=sum(status.state in NOT_OK for status in client.statuses),
                dropped=client.statuses[-1].drop_reasons or "none",
                latencies_ms=latencies,
                ate_m=absolute_error(client.online_trajectory(T_base_camera), truth).rmse_m,
                played_s=watch.played_s,
                loads=loads,
            )
    finally:
        if player is not None:
            player.stop()
        slam.stop()


def _ready(client: MeslamClient) -> bool:
    """Whether all nodes are there and will be heard."""
    named = [client.node.resolve_topic_name(name) for name in (topics.POSE, topics.ODOMETRY)]
    there = set(client.node.get_node_names())
    return set(NODES) <= there and all(client.node.count_publishers(name) for name in named)


def processes_of(parent: int) -> dict[str, int]:
    """Process numbers of the nodes that a process started, by name (Linux)."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    found = {"slam_node": parent}
    for pid in map(int, children):
        command = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        found.update({name: pid for name in NODES if f"meslam_ros.{name}" in command})
    return found


def cpu_s(pid: int) -> float:
    """Processor time of a process so far [s] (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def offline_ate_m(mcap: Path, truth_file: Path, frames: int) -> float:
    """Online ATE of `meslam run` on the same frames [m]."""
    with tempfile.TemporaryDirectory() as folder, closing(open_recording(mcap)) as recording:
        options = RunOptions(frames=slice(frames or None), truth=truth_file)
        outcome = run(recording, MeslamConfig(), Path(folder), options)
    return float(outcome.report["ate_online_rmse_m"])


def table_of(results: Sequence[LiveResult], offline_m: float) -> Table:
    """One row a run, and what is wanted."""
    table = Table(title=f"{RECORDING} at {FPS:g} fps into separate processes")
    for column in ("run", "frames", "with pose", "not OK", "dropped"):
        table.add_column(column)
    for column in ("median [ms]", "95 % [ms]", "99 % [ms]", "ATE online [cm]", "offline [cm]"):
        table.add_column(column, justify="right")
    for number, result in enumerate(results):
        table.add_row(
            str(number),
            str(result.frames),
            f"{result.share:.1%}",
            str(result.not_ok),
            result.dropped,
            *(f"{result.percentile(percent):.0f}" for percent in (50, 95, 99)),
            f"{result.ate_m * 100:.2f}",
            f"{offline_m * 100:.2f}",
        )
    table.add_section()
    table.add_row(
        "wanted",
        "",
        f"≥ {TARGETS['share']:.0%}",
        "",
        "",
        f"≤ {TARGETS['median_ms']:.0f}",
        f"≤ {TARGETS['p95_ms']:.0f}",
        "",
        f"± {TARGETS['ate_difference_m'] * 100:.1f}",
        "",
    )
    return table


def loads_of(results: Sequence[LiveResult]) -> Table:
    """Processor time and memory of each process, the largest of all runs."""
    table = Table("process", "of one core", "peak [MB]", title="Load")
    for name in results[0].loads:
        share = max(result.loads[name].cpu_s / result.played_s for result in results)
        peak = max(result.loads[name].peak_mb for result in results)
        table.add_row(name, f"{share:.0%}", f"{peak:.0f}")
    return table


def met(results: Sequence[LiveResult], offline_m: float) -> bool:
    """Whether every run is as it is wanted."""
    return all(
        result.share >= TARGETS["share"]
        and result.percentile(50) <= TARGETS["median_ms"]
        and result.percentile(95) <= TARGETS["p95_ms"]
        and result.ate_m <= offline_m + TARGETS["ate_difference_m"]
        for result in results
    )


def plot(results: Sequence[LiveResult], path: Path) -> None:
    """Latency over the frames, and its distribution."""
    figure, (over, spread) = plt.subplots(
        1, 2, figsize=(10, 3.2), width_ratios=(2, 1), layout="constrained"
    )
    for number, result in enumerate(results):
        over.plot(result.latencies_ms, lw=0.8, label=f"run {number}")
        spread.plot(np.sort(result.latencies_ms), np.linspace(0, 100, result.poses), lw=1.2)
    for percent, limit in ((50, TARGETS["median_ms"]), (95, TARGETS["p95_ms"])):
        spread.plot(limit, percent, "k<", ms=5)
    over.set(xlabel="frame", ylabel="latency [ms]", ylim=(0, None))
    spread.set(xlabel="latency [ms]", ylabel="share of the poses [%]", xlim=(0, None))
    for axes in (over, spread):
        axes.grid(alpha=0.3)
    over.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def mcap_of(source: Path) -> Path:
    """The recording as mcap, made once."""
    target = CACHE / f"{source.name}.mcap"
    if not target.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with closing(open_recording(source)) as recording:
            convert(recording, target)
    return target


def main() -> int:
    """Play, print, and write the results; the exit status says whether they are as wanted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--frames", type=int, default=0, help="of the recording; 0 for all")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    data = os.environ.get("MESLAM_DATA")
    if not data or not (Path(data) / RECORDING).is_dir():
        raise SystemExit(f"MESLAM_DATA must name the folder that holds {RECORDING}")
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(free_domain(os.getpid())))
    truth_file = Path(data) / RECORDING / "groundtruth.txt"
    mcap = mcap_of(Path(data) / RECORDING)
    truth = read_tum(truth_file)
    console = Console(width=150, markup=False)
    offline_m = offline_ate_m(mcap, truth_file, options.frames)
    results = []
    for number in range(options.runs):
        with tempfile.TemporaryDirectory() as folder, console.status(f"run {number}"):
            results.append(play(mcap, truth, Path(folder), options.frames))
    tables = (table_of(results, offline_m), loads_of(results))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "node_latency"
    described, command = machine(LIBRARIES), "python benchmarks/node_latency.py"
    with stem.with_suffix(".txt").open("w", encoding="utf-8") as file:
        file.write(f"Made by `{command}`\n\n{machine_line(described)}\n\n")
        for table in tables:
            Console(file=file, width=150, markup=False).print(table)
    for table in tables:
        console.print(table)
    content = {
        "command": command,
        "machine": described,
        "recording": RECORDING,
        "fps": FPS,
        "offline_ate_online_m": offline_m,
        "targets": TARGETS,
        "met": met(results, offline_m),
        "runs": [asdict(result) for result in results],
    }
    stem.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n")
    plot(results, stem.with_suffix(".png"))
    return 0 if content["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
