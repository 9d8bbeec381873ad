"""A large scene: MeSLAM beside one network and beside itself without each of its parts.

    python benchmarks/large_scene.py

The paper's experiments in a large scene, on the simulated `building`: a path of about 100 m over
several rooms and a corridor, seen by a simulated D435, with exact poses and surface. It is made
first (`meslam simulate building`) unless `--recording` names one. Every method runs in a process
of its own, one after the other, on the same machine: every frame, none skipped.

ATE is that of all frames, tracked or not, after rigid alignment. The map's error is the distance
of the true surface that the camera saw to the map's zero crossing, at most the truncation, which
also counts where the map knows nothing; medians over the boxes of the lattice. The jump of the
surface is taken where regions take over from each other (`meslam_core.evaluation.seams`). The
error of a region that is come back to is that of its own map alone, always on the surface it had
observed when it was left first, after rigid alignment: where the region lies is what ATE and the
error of the whole map tell.

Finished runs are kept in benchmarks/.cache and not repeated, unless `--again METHOD` says so.
Writes a table, JSON and a plot to docs/benchmarks/large_scene.*.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from large_scene_errors import by_box, memory_over_path, path_m, revisits, surface_errors
from large_scene_figures import Path2d, plot, tables
from large_scene_run import FRAMES
from machine import machine, machine_line
from numpy.typing import NDArray
from rich.console import Console
from simulated import simulated

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.reconstruction import observed_surface
from meslam_core.evaluation.seams import seam_jumps
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.map.neural_map import NeuralMap
from meslam_core.recordings.registry import open_recording
from meslam_core.regions.grid import RegionGrid
from meslam_core.results import MAP, ONLINE_TRAJECTORY, REPORT, TRAJECTORY
from meslam_core.se3 import Pose, inverse
from meslam_core.trajectory import read_tum

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "large_scene"
LIBRARIES = ("torch", "open3d-cpu", "numpy")
QUICK_FRAMES, QUICK_S = ":60", 4.0
MEAN_OVER_FRAMES = 30
# As `imap_star` has it, in a cube as large as the building.
ONE_NETWORK = (
    "regions.single=true",
    "regions.volume_m3=110592",
    "regions.mask_voxel_m=0.16",
    "regions.mask_extent=1",
    "field.embedding_sigma=100",
)


@dataclass(frozen=True)
class Method:
    """What is compared.

    Attributes:
        name: for people.
        settings: that differ from the preset.
        preset: of the configuration.
    """

    name: str
    settings: tuple[str, ...] = ()
    preset: str = "default"


METHODS = {
    "meslam": Method("MeSLAM"),
    "no_loops": Method("without loop closure", ("regions.close_loops=false",)),
    "no_odometry": Method("without odometry", ("odometry.method=none",)),
    "no_continuation": Method("without continuation", ("regions.initialisation=random",)),
    "no_regions": Method("without regions", ONE_NETWORK),
    "imap_star": Method("iMAP* (one network, no odometry)", preset="imap_star"),
}


@dataclass(frozen=True)
class Job:
    """One run of one method.

    Attributes:
        method: key of METHODS.
        frames: `A:B[:STEP]`.
        seed: of every random choice.
        recording: made by the simulator.
    """

    method: str
    frames: str
    seed: int
    recording: Path

    @property
    def out(self) -> Path:
        """Folder of the results."""
        frames = self.frames.replace(":", "-")
        return CACHE / self.recording.stem / frames / f"{self.method}_{self.seed}"

    @property
    def done(self) -> bool:
        """Whether its results are there."""
        return (self.out / FRAMES).exists()

    def command(self) -> list[str]:
        """What runs it."""
        method = METHODS[self.method]
        command = [sys.executable, str(HERE / "large_scene_run.py"), str(self.recording)]
        command += ["--out", str(self.out), "--preset", method.preset]
        command += ["--frames", self.frames, "--seed", str(self.seed)]
        for setting in method.settings:
            command += ["--set", setting]
        return command


class Scene:
    """The truth of a recording that the simulator made.

    Attributes:
        camera: of the recording.
        truth: T_truth_camera of all its frames.
    """

    def __init__(self, recording: Path) -> None:
        with closing(open_recording(recording)) as opened:
            self.camera = opened.camera
        self.truth = read_tum(recording.with_suffix(".truth.txt"))
        self._surface = o3d.io.read_triangle_mesh(str(recording.with_suffix(".surface.ply")))
        self._seen: dict[int, NDArray[np.float32]] = {}

    def seen(self, frames: int) -> NDArray[np.float32]:
        """Points (N, 3) of the surface that the first frames saw, truth's frame [m]."""
        if frames not in self._seen:
            path = self.truth.subset(np.arange(frames))
            self._seen[frames] = observed_surface(
                self._surface, self.camera, path, spacing_m=0.05, every=10, pixel_step=8
            )
        return self._seen[frames]


def evaluated(job: Job, scene: Scene) -> tuple[dict[str, Any], Path2d]:
    """Figures of a finished run, and what is drawn of it."""
    report = json.loads((job.out / REPORT).read_text())
    notes = dict(np.load(job.out / FRAMES, allow_pickle=False))
    refined = absolute_error(read_tum(job.out / TRAJECTORY), scene.truth)
    online = absolute_error(read_tum(job.out / ONLINE_TRAJECTORY), scene.truth)
    along_m = path_m(refined.truth)
    length_m = float(along_m[-1])
    neural_map = NeuralMap.load(job.out / MAP)
    T_map_truth = inverse(refined.mounting.T_truth_map)
    surface = _moved(scene.seen(len(along_m)), T_map_truth)
    errors, known = surface_errors(neural_map, surface)
    first = T_map_truth[:3, :3] @ refined.truth.positions[0] + T_map_truth[:3, 3]
    boxes = by_box(errors, surface, RegionGrid.around(first, MeslamConfig().regions))
    medians = np.array(list(boxes.values()))
    seams = seam_jumps(neural_map)
    figures = {
        "frames": report["frames"],
        "frames_tracked": report["frames_tracked"],
        "frames_degraded": report["frames_degraded"],
        "path_m": length_m,
        "regions": report["regions"],
        "corrections": report["corrections"],
        "ate_m": refined.rmse_m,
        "ate_online_m": online.rmse_m,
        "ate_of_path": refined.rmse_m / length_m,
        "ate_online_of_path": online.rmse_m / length_m,
        "map_error_m": {
            "median": float(np.median(medians)),
            "worst": float(medians.max()),
            "known": float(known.mean()),
            "boxes": {str(box): error for box, error in boxes.items()},
        },
        "seams": seams.to_dict() if seams.places else None,
        "revisits": revisits(report["visits"]),
        "fps": report["fps"],
        "online_s": report["online_s"],
        "wall_s": report["wall_s"],
        "stage_ms": report["stage_ms"],
        "map_bytes": report["map_bytes"],
        "memory": memory_over_path(notes["peak_mb"], along_m),
        "refined_mb": report["refined_mb"],
        "peak_mb": report["peak_mb"],
        "settings": list(METHODS[job.method].settings),
        "preset": METHODS[job.method].preset,
        "along_path": _thinned(notes, along_m, online.errors_m, refined.errors_m),
    }
    drawn = Path2d(refined.estimate, refined.truth, along_m, online.errors_m, notes)
    return figures, drawn


def _moved(points: NDArray[np.floating], T: Pose) -> NDArray[np.float64]:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], np.float64)


def _thinned(
    notes: dict[str, NDArray[Any]],
    along_m: NDArray[np.float64],
    online_m: NDArray[np.float64],
    refined_m: NDArray[np.float64],
) -> dict[str, list[float]]:
    """What changes along the path, one value every few frames."""
    chosen = slice(MEAN_OVER_FRAMES - 1, None, MEAN_OVER_FRAMES)
    kept = {name: notes[name][chosen] for name in ("rss_mb", "peak_mb", "regions", "resting")}
    kept |= {
        "path_m": along_m[chosen],
        "online_m": online_m[chosen],
        "refined_m": refined_m[chosen],
    }
    kept["frame_ms"] = np.diff(notes["wall_s"][chosen], prepend=0.0) / MEAN_OVER_FRAMES * 1e3
    return {name: np.round(values.astype(float), 4).tolist() for name, values in kept.items()}


def write(
    summary: dict[str, dict[str, Any]], paths: dict[str, Path2d], options: argparse.Namespace
) -> None:
    """The table, JSON and plot."""
    names = {key: method.name for key, method in METHODS.items()}
    shown = tables(summary, names)
    console = Console(width=150, markup=False)
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / ("large_scene_quick" if options.quick else "large_scene")
    described = machine(LIBRARIES)
    command = " ".join(["python", "benchmarks/large_scene.py", *options.told])
    with stem.with_suffix(".txt").open("w") as file:
        file.write(f"Made by `{command}`\n\n{machine_line(described)}\n{options.note}\n")
        for table in shown:
            console.print(table)
            Console(file=file, width=150, markup=False).print(table)
    result = {
        "command": command,
        "machine": described,
        "note": options.note,
        "results": summary,
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    plot(summary, paths, names, stem.with_suffix(".png"))


def chosen_recording(options: argparse.Namespace) -> Path:
    """The recording, made where it is not there yet."""
    if options.recording is not None:
        return Path(options.recording).resolve()
    if options.quick:
        return simulated("building", CACHE / "building_quick.mcap", "--duration", str(QUICK_S))
    return simulated("building", CACHE / "building.mcap")


def frames_of(method: str, options: argparse.Namespace) -> str:
    """Which frames a method runs on: `--frames` has `A:B` for all, or `METHOD=A:B` for one."""
    chosen = ":"
    for text in options.frames:
        name, equals, frames = text.rpartition("=")
        if not equals or name == method:
            chosen = frames
    return chosen


def parsed_options(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recording", type=Path, help="made by `meslam simulate` before")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--again", nargs="+", choices=METHODS, default=[], help="run these anew")
    parser.add_argument(
        "--frames", nargs="+", default=[":"], metavar="[METHOD=]A:B", help="of all, or of a method"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_S:g} s of it")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--note", default="", help="remark for the results")
    options = parser.parse_args(arguments)
    if options.quick:
        options.frames = [QUICK_FRAMES]
    options.told = _told(arguments)
    return options


def _told(arguments: list[str]) -> list[str]:
    """The arguments that change the results, as they are written beside them."""
    told, skipped = [], False
    for argument in arguments:
        if skipped or argument in ("--recording", "--out", "--note"):
            skipped = not skipped
            continue
        told.append(argument)
    return told


def main() -> None:
    options = parsed_options(sys.argv[1:])
    recording = chosen_recording(options)
    jobs = [
        Job(method, frames_of(method, options), options.seed, recording)
        for method in options.methods
    ]
    for number, job in enumerate(jobs, start=1):
        if job.method in options.again or not job.done:
            print(f"{number}/{len(jobs)}: {METHODS[job.method].name}, frames {job.frames}")
            subprocess.run(job.command(), cwd=HERE, check=True)
    scene = Scene(recording)
    results = {job.method: evaluated(job, scene) for job in jobs}
    write(
        {method: figures for method, (figures, _) in results.items()},
        {method: drawn for method, (_, drawn) in results.items()},
        options,
    )


if __name__ == "__main__":
    main()
