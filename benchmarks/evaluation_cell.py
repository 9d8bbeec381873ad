"""One cell of the evaluation: one method on one recording with one seed.

    python benchmarks/evaluation_cell.py NAME RECORDING TRUTH METHOD --out FOLDER [--seed N] ...

Runs the method, then judges what it left and writes CELL to the folder, last and in one step: a
cell without it is not done. A map is judged where the true surface is known: ours meshed at 2 cm,
the peers' the TSDF volume that Open3D makes of the same frames at their refined poses.

Exit status 3 when evo and our own evaluation disagree.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from classic_maps import TsdfVolume
from evo_check import DisagreementError, check_agreement, evo_rmse
from machine import busy_core_s
from numpy.typing import NDArray
from slam_run import HERE, Sequence, SlamRun

import meslam_core
from meslam_core.config import MeslamConfig
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.alignment import associate
from meslam_core.evaluation.reconstruction import observed_surface, surface_error
from meslam_core.evaluation.trajectory_error import (
    AbsoluteError,
    relative_error_by_frames,
    relative_error_by_time,
)
from meslam_core.loop.pose_graph import rigid_motion
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import to_open3d
from meslam_core.map.neural_map import NeuralMap
from meslam_core.recordings import open_recording
from meslam_core.results import MAP
from meslam_core.tracking.pixels import trusted_pixels
from meslam_core.trajectory import read_tum, write_tum

CELL = "cell.json"
LOG = "log.txt"
DISAGREES = 3
MESH_M = 0.02
VOXEL_M = 0.01
TRUNCATION_M = 0.08


def code_version() -> str:
    """Of the package, and the last commit that changed what is measured."""
    command = ["git", "log", "-1", "--format=%h", "--", "src", "benchmarks/peers"]
    try:
        ended = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return meslam_core.__version__
    return f"{meslam_core.__version__} ({ended.stdout.strip()})"


def run_and_watch(job: SlamRun) -> dict[str, Any]:
    """Run a method, and tell what else the machine had to do meanwhile."""
    load = os.getloadavg()[0]
    busy_s, own_s, started = busy_core_s(), _children_s(), time.perf_counter()
    with (job.out.parent / f"{job.out.name}.{LOG}").open("w") as log:
        job.run(log)
    wall_s = time.perf_counter() - started
    others_s = busy_core_s() - busy_s - (_children_s() - own_s)
    return {"load_average": round(load, 2), "others_cores": max(0.0, others_s / wall_s)}


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def trajectory_figures(job: SlamRun) -> dict[str, Any]:
    """Errors of all frames, and evo's beside ours.

    Raises:
        DisagreementError: when evo says something else.
    """
    refined = job.sequence.error_of(job.of_all_frames())
    live = job.sequence.error_of(job.of_all_frames(online=True))
    steps = relative_error_by_frames(refined.estimate, refined.truth)
    figures: dict[str, Any] = {
        "ate_m": refined.rmse_m,
        "ate_online_m": live.rmse_m,
        "rpe_frame_m": steps.trans_rmse_m,
        "rpe_frame_deg": steps.rot_rmse_deg,
        "rpe_m": None,
        "rpe_deg": None,
    }
    try:
        second = relative_error_by_time(refined.estimate, refined.truth)
    except EvaluationError:
        pass
    else:
        figures |= {"rpe_m": second.trans_rmse_m, "rpe_deg": second.rot_rmse_deg}
    figures["evo"] = {
        "ate_m": _agreed(job, refined, False),
        "ate_online_m": _agreed(job, live, True),
        "rpe_frame_m": _agreed(job, refined, False, relative=True),
    }
    return figures


def _agreed(
    job: SlamRun, error: AbsoluteError, online: bool, *, relative: bool = False
) -> float | None:
    """What evo says of a trajectory [m], which is what we say."""
    path = job.out / f"all_frames{'_online' if online else ''}.txt"
    # evo knows no lever arm: it is given the poses with it, and must not align them again.
    fitted = job.sequence.lever_arm
    write_tum(path, error.estimate if fitted else job.of_all_frames(online=online))
    evo_m = evo_rmse(path, job.sequence.truth, relative=relative, align=not fitted)
    if relative:
        ours_m = relative_error_by_frames(error.estimate, error.truth).trans_rmse_m
    else:
        ours_m = error.rmse_m
    check_agreement(f"{job.sequence.name}, {job.method}, {path.name}", ours_m, evo_m)
    return evo_m


def map_figures(job: SlamRun) -> dict[str, Any]:
    """Bytes of the map, and its errors where the true surface is known."""
    if job.is_peer:
        volume = fused(job)
        figures: dict[str, Any] = {"map_bytes": volume.content().deflated_bytes}
        if job.sequence.surface is None:
            return figures
        mesh = volume.mesh()
    else:
        figures = {"map_bytes": job.report["map_bytes"], "regions": job.report["regions"]}
        if job.sequence.surface is None:
            return figures
        mesh = to_open3d(extract_mesh(NeuralMap.load(job.out / MAP), MESH_M))
    surface = o3d.io.read_triangle_mesh(str(job.sequence.surface))
    # By poses, not by positions: those of a short path leave a wall's place open by centimetres.
    estimate, truth = associate(job.trajectory(), read_tum(job.sequence.truth))
    moved = rigid_motion(estimate.poses, truth.poses)
    try:
        error = surface_error(mesh, surface, observed(job, surface), T_truth_map=moved)
    except EvaluationError as reason:
        return {**figures, "surface_failed": str(reason)}
    return {**figures, **error.to_dict()}


def fused(job: SlamRun) -> TsdfVolume:
    """The trusted pixels of all tracked frames at their refined poses."""
    sensor = MeslamConfig().sensor
    volume = TsdfVolume(VOXEL_M, TRUNCATION_M, sensor.max_depth_m)
    refined = job.trajectory()
    poses = dict(zip(refined.stamps_ns.tolist(), refined.poses, strict=True))
    chosen = job.chosen
    with closing(open_recording(job.sequence.recording)) as recording:
        for frame in recording.frames(chosen.start or 0, chosen.stop, chosen.step or 1):
            if frame.stamp_ns in poses:
                trusted = trusted_pixels(frame.depth_m, sensor)
                depth_m = np.where(trusted, frame.depth_m, np.float32(0.0))
                volume.add(depth_m, frame.color, frame.camera, poses[frame.stamp_ns])
    return volume


def observed(job: SlamRun, surface: o3d.geometry.TriangleMesh) -> NDArray[np.float32]:
    """Points (N, 3) of the true surface that the frames show [m]; kept for the other methods."""
    kept = job.out.parent / f"observed_{job.frames.replace(':', '-')}.npy"
    if kept.exists():
        points: NDArray[np.float32] = np.load(kept, allow_pickle=False)
        return points
    with closing(open_recording(job.sequence.recording)) as recording:
        camera = recording.camera
    truth = read_tum(job.sequence.truth)
    shown = truth.subset(np.flatnonzero(np.isin(truth.stamps_ns, job.stamps_ns)))
    farthest_m = MeslamConfig().sensor.max_depth_m
    points = observed_surface(surface, camera, shown, farthest_m=farthest_m)
    partial = kept.with_name(f".{os.getpid()}.npy")
    np.save(partial, points, allow_pickle=False)
    partial.replace(kept)
    return points


def judged(job: SlamRun) -> dict[str, Any]:
    """Run and judge a cell."""
    started = time.perf_counter()
    watched = run_and_watch(job)
    report = job.report
    return {
        "recording": job.sequence.name,
        "method": job.method,
        "seed": job.seed,
        "frames": job.frames,
        "frames_offered": len(job.stamps_ns),
        "frames_tracked": len(job.trajectory(online=True)),
        **trajectory_figures(job),
        **map_figures(job),
        "fps": report["fps"],
        "wall_s": report["wall_s"],
        "peak_rss_mb": report["peak_rss_mb"],
        **watched,
        "cores": job.cores,
        "cell_s": time.perf_counter() - started,
        "version": code_version(),
        "date": datetime.now(UTC).date().isoformat(),
    }


def parsed_job() -> SlamRun:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("name", help="of the recording, for people")
    parser.add_argument("recording", type=Path)
    parser.add_argument("truth", type=Path, help="true poses, TUM format")
    parser.add_argument("method", help="a preset of MeSLAM, `meslam`, or a peer")
    parser.add_argument("--lever-arm", action="store_true", help="the truth is another sensor's")
    parser.add_argument("--surface", type=Path, help="the exact surface")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", default=":", metavar="A:B[:STEP]")
    parser.add_argument("--cores", type=int, default=2, help="that the method may use")
    parser.add_argument("--out", type=Path, required=True, help="folder of the cell")
    told = parser.parse_args()
    sequence = Sequence(told.name, told.recording, told.truth, told.lever_arm, told.surface)
    return SlamRun(sequence, told.method, told.seed, told.frames, told.cores, told.out)


def main() -> None:
    job = parsed_job()
    job.out.parent.mkdir(parents=True, exist_ok=True)
    (job.out / CELL).unlink(missing_ok=True)
    try:
        cell = judged(job)
    except DisagreementError as error:
        print(f"evaluation: {error}", file=sys.stderr)
        sys.exit(DISAGREES)
    partial = job.out / f".{CELL}.partial"
    partial.write_text(json.dumps(cell, indent=1, allow_nan=False) + "\n")
    partial.replace(job.out / CELL)


if __name__ == "__main__":
    main()
