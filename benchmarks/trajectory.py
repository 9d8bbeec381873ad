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
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, machine_line
from peers import pose_graph_slam, tsdf_slam
from rich.console import Console
from trajectory_figures import Path3d, plot, spread, table_of

from meslam_core.errors import EvaluationError
from meslam_core.evaluation.trajectory_error import (
    AbsoluteError,
    absolute_error,
    frame_jitter_m,
    relative_error_by_frames,
)
from meslam_core.recordings import open_recording
from meslam_core.results import ONLINE_TRAJECTORY, REPORT, TRAJECTORY
from meslam_core.trajectory import Trajectory, read_tum

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
# The peers may have settings of their own for a camera; MeSLAM has the same for all.
SETTINGS = {"tsdf": tsdf_slam.SETTINGS, "pose_graph": pose_graph_slam.SETTINGS}
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


@dataclass(frozen=True)
class Sequence:
    """A recording in the folder MESLAM_DATA.

    Attributes:
        truth: file of true poses in it.
        lever_arm: the true poses are another sensor's on the same mount; its place is fitted.
    """

    truth: str
    lever_arm: bool = False


SEQUENCES = {
    "tum_fr1_xyz": Sequence("groundtruth.txt"),
    "livingroom": Sequence("reference_poses.txt"),
    "d435_desk": Sequence("t265_poses.txt", lever_arm=True),
}


@dataclass(frozen=True)
class Job:
    """One run of one method.

    Attributes:
        recording: name of the sequence.
        method: key of METHODS.
        seed: of MeSLAM; the number of the repetition for the others.
        frames: `A:B:STEP`.
        cores: that may be used.
    """

    recording: str
    method: str
    seed: int
    frames: str
    cores: int

    @property
    def out(self) -> Path:
        """Folder of the results."""
        frames = self.frames.replace(":", "-")
        return CACHE / self.recording / frames / f"{self.method}_{self.seed}_{self.cores}cores"

    @property
    def chosen(self) -> slice:
        """The frames."""
        return slice(*(int(part) if part else None for part in self.frames.split(":")))

    def command(self, data: Path) -> list[str]:
        """What runs it, in the folder of this file."""
        common = [str(data / self.recording), "--out", str(self.out), "--frames", self.frames]
        if self.method == "meslam":
            program = shutil.which("meslam", path=Path(sys.executable).parent) or "meslam"
            truth = str(data / self.recording / SEQUENCES[self.recording].truth)
            lever_arm = ["--lever-arm"] if SEQUENCES[self.recording].lever_arm else []
            seed = ["--seed", str(self.seed)]
            return [program, "run", *common, "--truth", truth, *lever_arm, *seed]
        best = SETTINGS[self.method].get(self.recording, ())
        settings = [word for setting in best for word in ("--set", setting)]
        return [sys.executable, "-m", "peers", self.method, *common, *settings]


def run(job: Job, data: Path) -> None:
    """Run a job in a process of its own, on its share of the cores."""
    shutil.rmtree(job.out, ignore_errors=True)
    job.out.parent.mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    # MeSLAM divides its cores itself.
    environment.pop("OMP_NUM_THREADS", None)
    if job.method != "meslam":
        environment["OMP_NUM_THREADS"] = str(job.cores)

    def confine() -> None:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job.cores])

    subprocess.run(job.command(data), cwd=HERE, env=environment, check=True, preexec_fn=confine)


def held(trajectory: Trajectory, stamps_ns: np.ndarray) -> Trajectory:
    """Poses at all stamps of the frames; one that was not tracked has the last pose before it."""
    last = np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right") - 1
    return Trajectory(stamps_ns, trajectory.poses[np.maximum(last, 0)])


def error_of(trajectory: Trajectory, truth: Trajectory, sequence: Sequence) -> AbsoluteError:
    """ATE; without a lever arm where the trajectory turns too little to tell it (lost early)."""
    try:
        return absolute_error(trajectory, truth, hand_eye=sequence.lever_arm)
    except EvaluationError:
        return absolute_error(trajectory, truth)


def evaluated(job: Job, data: Path) -> tuple[dict[str, Any], AbsoluteError]:
    """Figures of a finished run, and the error of its refined trajectory."""
    sequence = SEQUENCES[job.recording]
    truth = read_tum(data / job.recording / sequence.truth)
    recording = open_recording(data / job.recording)
    stamps_ns = np.asarray(recording.stamps_ns)[job.chosen]
    recording.close()
    report = json.loads((job.out / REPORT).read_text())
    refined = read_tum(job.out / TRAJECTORY)
    online = read_tum(job.out / ONLINE_TRAJECTORY)
    absolute = error_of(held(refined, stamps_ns), truth, sequence)
    live = error_of(held(online, stamps_ns), truth, sequence)
    mounting = live.mounting
    tracked = online.transformed(mounting.T_truth_map, mounting.T_camera_sensor)
    return {
        "seed": job.seed,
        "frames": len(stamps_ns),
        "frames_tracked": len(online),
        "ate_m": absolute.rmse_m,
        "ate_online_m": live.rmse_m,
        "ate_tracked_m": error_of(refined, truth, sequence).rmse_m,
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
    jobs: list[Job], data: Path
) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Path3d]]]:
    """Figures of all finished runs by recording and method, and the path of each median run."""
    summary: dict[str, dict[str, Any]] = {}
    paths: dict[str, dict[str, Path3d]] = {}
    for recording in dict.fromkeys(job.recording for job in jobs):
        for method in dict.fromkeys(job.method for job in jobs):
            chosen = [job for job in jobs if (job.recording, job.method) == (recording, method)]
            results = [evaluated(job, data) for job in chosen if (job.out / REPORT).exists()]
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
    Console(width=160).print(table)
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / ("trajectory_quick" if options.quick else "trajectory")
    described = machine(LIBRARIES)
    command = " ".join(["python", "benchmarks/trajectory.py", *sys.argv[1:]])
    with stem.with_suffix(".txt").open("w") as file:
        file.write(f"Made by `{command}`\n\n{machine_line(described)}; ")
        file.write(f"every run on {options.cores} cores\n{options.note}\n")
        Console(file=file, width=160).print(table)
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
    parser.add_argument("--recordings", nargs="+", choices=SEQUENCES, default=list(SEQUENCES))
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
    data = Path(os.environ["MESLAM_DATA"]).resolve()
    jobs = [
        Job(recording, method, seed, options.frames, options.cores)
        for seed in range(options.seeds)
        for recording in options.recordings
        for method in options.methods
    ]
    for number, job in enumerate(jobs, start=1):
        if job.method in options.again or not (job.out / REPORT).exists():
            print(f"{number}/{len(jobs)}: {job.recording}, {job.method}, seed {job.seed}")
            run(job, data)
    write(*collect(jobs, data), options)


if __name__ == "__main__":
    main()
