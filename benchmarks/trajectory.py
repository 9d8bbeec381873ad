"""Trajectory error and speed on recordings, against dense TSDF SLAM and a pose graph.

    MESLAM_DATA=... python benchmarks/trajectory.py

Every run has a process of its own, takes its frames from the same loader and may use the same
number of cores. Wall time is from before the first image is read until the trajectory is refined.
Errors are those of all frames of the recording: one that was not tracked has the last pose before
it; jitter (frame-to-frame error) is that of consecutive tracked frames. The peers have no random
choices; they run as often as MeSLAM has seeds because threads make sums differ.

Finished runs are kept in benchmarks/.cache and not repeated, unless `--again METHOD` says so.
Writes a table, JSON and a plot to docs/benchmarks/trajectory.*.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, machine_line
from peers import pose_graph_slam, tsdf_slam
from rich.console import Console
from slam_run import Sequence, SlamRun
from trajectory_figures import Path3d, plot, spread, table_of

from meslam_core.evaluation.trajectory_error import (
    AbsoluteError,
    frame_jitter_m,
    relative_error_by_frames,
)
from meslam_core.trajectory import read_tum

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "trajectory"
QUICK_FRAMES = 40
LIBRARIES = ("open3d-cpu", "gtsam", "torch", "numpy")
METHODS = {
    "meslam": "MeSLAM",
    "tsdf": "TSDF SLAM (Open3D)",
    "pose_graph": "pose graph (Open3D, GTSAM)",
}
# True poses by recording.
RECORDINGS = {
    "tum_fr1_xyz": "groundtruth.txt",
    "livingroom": "reference_poses.txt",
    "d435_desk": "t265_poses.txt",
}
TRIED = {"tsdf": tsdf_slam.TRIED, "pose_graph": pose_graph_slam.TRIED}
FIGURES = (
    "frames_tracked",
    "ate_m",
    "ate_online_m",
    "jitter_rms_m",
    "jitter_median_m",
    "fps",
    "peak_rss_mb",
)


def sequences(data: Path) -> dict[str, Sequence]:
    """The recordings in the folder MESLAM_DATA, by name."""
    return {
        name: Sequence(name, data / name, data / name / truth, lever_arm=name == "d435_desk")
        for name, truth in RECORDINGS.items()
    }


def out_of(recording: str, method: str, seed: int, options: argparse.Namespace) -> Path:
    """Folder of a run's results."""
    frames = options.frames.replace(":", "-")
    return CACHE / recording / frames / f"{method}_{seed}_{options.cores}cores"


def evaluated(job: SlamRun) -> tuple[dict[str, Any], AbsoluteError]:
    """Figures of a finished run, and the error of its refined trajectory."""
    sequence = job.sequence
    truth = read_tum(sequence.truth)
    refined, online = job.trajectory(), job.trajectory(online=True)
    absolute = sequence.error_of(job.of_all_frames())
    live = sequence.error_of(job.of_all_frames(online=True))
    mounting = live.mounting
    tracked = online.transformed(mounting.T_truth_map, mounting.T_camera_sensor)
    report = job.report
    return {
        "seed": job.seed,
        "frames": len(job.stamps_ns),
        "frames_tracked": len(online),
        "ate_m": absolute.rmse_m,
        "ate_online_m": live.rmse_m,
        "ate_tracked_m": sequence.error_of(refined).rmse_m,
        "jitter_rms_m": frame_jitter_m(tracked, truth),
        "jitter_median_m": float(
            np.median(relative_error_by_frames(tracked, truth).translations_m)
        ),
        "fps": report["fps"],
        "wall_s": report["wall_s"],
        "peak_rss_mb": report["peak_rss_mb"],
        "parameters": report.get("parameters", report.get("config")),
    }, absolute


def collect(
    jobs: list[SlamRun],
) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Path3d]]]:
    """Figures of all finished runs by recording and method, and the path of each median run."""
    summary: dict[str, dict[str, Any]] = {}
    paths: dict[str, dict[str, Path3d]] = {}
    for recording in dict.fromkeys(job.sequence.name for job in jobs):
        for method in dict.fromkeys(job.method for job in jobs):
            wanted = recording, method
            chosen = [job for job in jobs if (job.sequence.name, job.method) == wanted]
            results = [evaluated(job) for job in chosen if job.done]
            if not results:
                continue
            runs = [figures for figures, _ in results]
            parameters = [figures.pop("parameters") for figures in runs][-1]
            summary.setdefault(recording, {})[method] = {
                "frames": runs[0]["frames"],
                **{key: spread(runs, key) for key in FIGURES},
                "parameters": parameters,
                "runs": runs,
            }
            middle = sorted(results, key=lambda result: result[0]["ate_m"])[len(results) // 2][1]
            paths.setdefault(recording, {})[method] = Path3d(
                middle.estimate.positions, middle.truth
            )
    return summary, paths


def write(
    summary: dict[str, dict[str, Any]],
    paths: dict[str, dict[str, Path3d]],
    options: argparse.Namespace,
) -> None:
    """The table, JSON and plot."""
    table = table_of(summary, METHODS)
    Console(width=160, markup=False).print(table)
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / ("trajectory_quick" if options.quick else "trajectory")
    described = machine(LIBRARIES)
    command = " ".join(["python", "benchmarks/trajectory.py", *sys.argv[1:]])
    with stem.with_suffix(".txt").open("w") as file:
        file.write(f"Made by `{command}`\n\n{machine_line(described)}; ")
        file.write(f"every run on {options.cores} cores\n{options.note}\n")
        Console(file=file, width=160, markup=False).print(table)
    result = {
        "command": command,
        "machine": described,
        "cores": options.cores,
        "note": options.note,
        "results": summary,
        "tried": TRIED,
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    plot(summary, paths, METHODS, stem.with_suffix(".png"))


def parsed_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--recordings", nargs="+", choices=RECORDINGS, default=list(RECORDINGS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--again", nargs="+", choices=METHODS, default=[], help="run these anew")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each method")
    parser.add_argument("--frames", default=":", metavar="A:B[:STEP]")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_FRAMES} frames, one seed")
    parser.add_argument("--cores", type=int, default=2, help="that every run may use")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--note", default="", help="remark for the results")
    options = parser.parse_args()
    if options.quick:
        options.frames, options.seeds = f"0:{QUICK_FRAMES}", 1
    return options


def main() -> None:
    options = parsed_options()
    if "MESLAM_DATA" not in os.environ:
        sys.exit("MESLAM_DATA must name the folder of the recordings")
    known = sequences(Path(os.environ["MESLAM_DATA"]).resolve())
    jobs = [
        SlamRun(
            known[recording],
            method,
            seed,
            options.frames,
            options.cores,
            out_of(recording, method, seed, options),
        )
        for seed in range(options.seeds)
        for recording in options.recordings
        for method in options.methods
    ]
    for number, job in enumerate(jobs, start=1):
        if job.method in options.again or not job.done:
            print(f"{number}/{len(jobs)}: {job.sequence.name}, {job.method}, seed {job.seed}")
            job.run()
    write(*collect(jobs), options)


if __name__ == "__main__":
    main()
