"""What the demo leaves behind: trajectories, pictures, a report, a summary for people."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from rich.console import Console
from rich.table import Table

from meslam_core.cli_report import PAGE
from meslam_core.config import MeslamConfig
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
from meslam_core.frame_log import FRAMES, FrameEntry, FrameLog
from meslam_core.frame_result import TrackingState
from meslam_core.recordings.recording import Recording
from meslam_core.report import read_run, write_report
from meslam_core.results import ONLINE_TRAJECTORY, TRAJECTORY
from meslam_core.run_report import run_environment
from meslam_core.simulation.writer import surface_path, truth_path
from meslam_core.trajectory import Trajectory, write_tum
from meslam_interfaces.msg import TrackingStatus
from meslam_interfaces.srv import ExportMap, SaveMap
from meslam_ros.conversions import stamp_ns

MESH, PATH_PICTURE, ERROR_PICTURE, VIEWS_PICTURE = "mesh.ply", "path.png", "error.png", "views.png"
MESH_RESOLUTION_M = 0.02
VIEWS = 3
HAS_POSE = (TrackingStatus.OK, TrackingStatus.DEGRADED)


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


def find_truth(path: Path, given: Path | None) -> Path | None:
    """File of true poses: those given, the simulator's, or a TUM folder's."""
    for candidate in (given, truth_path(path), path / "groundtruth.txt"):
        if candidate is not None and (candidate == given or candidate.is_file()):
            return candidate
    return None


def origin(recording: Recording, truth: Path | None, frames: int) -> dict[str, Any]:
    """What the report says of where the results come from."""
    return {
        "recording": recording.name,
        "recording_path": str(recording.path.absolute()),
        "frame_range": [0, None if frames == len(recording) else frames, 1],
        "camera": recording.camera.to_dict(),
        "truth": None if truth is None else str(truth.absolute()),
        "command": shlex.join(["python", *sys.argv]),
        # The nodes were started without parameters of their own.
        "config": MeslamConfig().to_mapping(),
    }


def write_page(out: Path, progress: Callable[[int, int], None]) -> None:
    """Make the page about the results in a folder."""
    run = read_run(out)
    try:
        write_report([run], out / PAGE, VIEWS, progress)
    finally:
        run.close()


def evaluate(
    recording: Recording, path: Path, truth: Trajectory | None, live: Live, staging: Path
) -> dict[str, Any]:
    """Write trajectories and pictures; the content of the report."""
    write_tum(staging / TRAJECTORY, live.refined)
    write_tum(staging / ONLINE_TRAJECTORY, live.online)
    _record(live.statuses, staging / FRAMES)
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


def _record(statuses: list[TrackingStatus], target: Path) -> None:
    """What the nodes told of every frame."""
    with FrameLog(target) as log:
        for status in statuses:
            log.add(
                FrameEntry(
                    stamp_ns=stamp_ns(status.header.stamp),
                    state=TrackingState(status.state).name,
                    reason=status.reason,
                    tracked=status.state in HAS_POSE,
                    keyframe=status.is_keyframe,
                    residual_m=status.residual_m,
                    inlier_ratio=status.inlier_ratio,
                    loss_distance=status.loss_distance if status.iterations else None,
                    loss_depth=status.loss_depth if status.iterations else None,
                    loss_color=status.loss_color if status.iterations else None,
                    iterations=status.iterations,
                    tracking_ms=status.tracking_ms,
                    mapping_ms=status.mapping_ms,
                    latency_ms=1e3 * status.latency_s,
                    skipped=status.frames_dropped,
                    keyframes=status.keyframes,
                    map_bytes=status.map_bytes,
                )
            )


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
        "frames_degraded": sum(status.state == TrackingStatus.DEGRADED for status in statuses),
        "final_state": TrackingState(last.state).name,
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
    console.print(f"look at {out / PAGE}", highlight=False, soft_wrap=True)
