"""What the exact continuation of a region's map in the next one gains.

    python benchmarks/continuation.py RECORDING.mcap [--frames N] [--seeds 0 1 2]

The recording comes from `meslam simulate` and has its exact poses and surface beside it. It is run
with new regions that continue the working region's map, with plainly copied weights (the paper's
initialisation) and from random weights, everything else being the same. Error of a new region's
map: the median distance, to its own surface, of the true surface that the working region had seen
of its box when it was born. Error of the pose: of the motion since the new region began to work.
Medians over all new regions; a table, JSON and a plot go to docs/benchmarks/continuation.*.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import open3d as o3d
from machine import machine, machine_line
from rich.console import Console
from rich.table import Table

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.continuation import Birth, BirthWatch, median_errors
from meslam_core.evaluation.reconstruction import sample
from meslam_core.odometry import make_odometry
from meslam_core.recordings.registry import open_recording
from meslam_core.se3 import inverse
from meslam_core.slam import T_BODY_OPTICAL, Slam
from meslam_core.threads import limit_threads
from meslam_core.trajectory import read_tum

mpl.use("Agg")
from matplotlib import pyplot as plt

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "benchmarks"
LIBRARIES = ("torch", "open3d-cpu", "numpy")
INITIALISATIONS = ("continued", "copied", "random")
SURFACE_POINTS = 400_000
COLORS = {"continued": "tab:green", "copied": "tab:orange", "random": "tab:red"}


def births(path: Path, config: MeslamConfig, seed: int, frames: int | None) -> list[Birth]:
    """Every region that a run creates, with its errors."""
    limit_threads(config.runtime.threads)
    truth = read_tum(path.with_suffix(".truth.txt"))
    surface = sample(
        o3d.io.read_triangle_mesh(str(path.with_suffix(".surface.ply"))), SURFACE_POINTS
    )
    T_map_truth = T_BODY_OPTICAL @ inverse(truth.poses[0])
    slam = Slam(config, seed)
    in_map = surface @ T_map_truth[:3, :3].T + T_map_truth[:3, 3]
    watch = BirthWatch(slam, in_map)
    with closing(open_recording(path)) as recording:
        odometry = make_odometry(config.odometry, config.sensor)
        for frame in recording.frames(0, frames, 1):
            result = slam.process(frame, odometry.process(frame))
            slam.wait()
            nearest = int(np.argmin(np.abs(truth.stamps_ns - frame.stamp_ns)))
            watch.follow(frame.stamp_ns, result.T_map_camera, truth.poses[nearest])
    return watch.births


def compared(path: Path, seeds: Sequence[int], frames: int | None) -> dict[str, dict[str, object]]:
    """Median errors by age, of the maps and of the poses, by initialisation."""
    results: dict[str, dict[str, object]] = {}
    for how in INITIALISATIONS:
        config = MeslamConfig()
        config = replace(config, regions=replace(config.regions, initialisation=how))
        found = [b for seed in seeds for b in births(path, config, seed, frames)]
        results[how] = {
            "regions": len(found),
            "switches": sum(birth.switched_ns is not None for birth in found),
            "map_error_m": median_errors(found, lambda birth: birth.map_errors),
            "pose_error_m": median_errors(found, lambda birth: birth.pose_errors),
        }
    return results


def table(results: dict[str, dict[str, object]], which: str, title: str) -> Table:
    """Errors in centimetres, one row an initialisation, one column an age."""
    ages = sorted({age for entry in results.values() for age in entry[which]})
    shown = Table("begins", *(f"{age:g} s" for age in ages), title=title)
    for how, entry in results.items():
        shown.add_row(how, *(f"{entry[which].get(age, np.nan) * 100:.2f}" for age in ages))
    return shown


def plot(results: dict[str, dict[str, object]], path: Path) -> None:
    """Both errors over the seconds."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    titles = ("map of the new region", "motion since it began to work")
    for axes, which, title in zip(panels, ("map_error_m", "pose_error_m"), titles, strict=True):
        for how, entry in results.items():
            ages = sorted(entry[which])
            errors = [entry[which][age] * 100 for age in ages]
            axes.plot(ages, errors, "o-", ms=3, label=how, color=COLORS[how])
        axes.set(xlabel="time [s]", ylabel="error [cm]", title=title, ylim=(0, None))
        axes.grid(alpha=0.3)
    panels[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, default=None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    results = compared(options.recording, options.seeds, options.frames)
    described, console = machine(LIBRARIES), Console(width=100, markup=False)
    tables = [
        table(results, "map_error_m", "Error of a new region's map [cm]"),
        table(results, "pose_error_m", "Error of the motion since the switch [cm]"),
    ]
    console.print(*tables)
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = " ".join(map(str, options.seeds))
    part = "" if options.frames is None else f" --frames {options.frames}"
    command = f"python benchmarks/continuation.py {options.recording.name}{part} --seeds {seeds}"
    with (options.out / "continuation.txt").open("w") as file:
        regions = ", ".join(f"{each['regions']} {how}" for how, each in results.items())
        file.write(f"Made by `{command}`\n\n{machine_line(described)}\n")
        file.write(f"Medians over new regions: {regions}\n\n")
        Console(file=file, width=100, markup=False).print(*tables)
    written = {
        "command": command,
        "machine": described,
        "recording": options.recording.name,
        "results": results,
    }
    (options.out / "continuation.json").write_text(json.dumps(written, indent=2) + "\n")
    plot(results, options.out / "continuation.png")


if __name__ == "__main__":
    main()
