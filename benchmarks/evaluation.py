"""The evidence: every recording at hand x every method x seeds, in one command.

    MESLAM_DATA=... python benchmarks/evaluation.py            hours: `make benchmark`
    MESLAM_DATA=... python benchmarks/evaluation.py --quick    minutes: `make benchmark-quick`

Recordings are the folders of MESLAM_DATA that have true poses (a sequence of the TUM RGB-D
benchmark is found by itself, whatever its name) and simulated scenes, which are made where they
are missing. Methods are MeSLAM with its presets, `imap_star` (the paper's baseline), Open3D's
dense TSDF SLAM, and RGB-D odometry with a pose graph. MeSLAM is run with three seeds, the others
once; methods with large networks get the first frames alone. `--dry-run` lists the cells.

Every cell has a process and a folder of its own in benchmarks/.cache/evaluation, so that an
interruption loses one cell; finished ones are not repeated, unless `--again METHOD` says so. evo
and our own evaluation must agree to a micrometre in every cell, or all stops. Writes
docs/benchmarks/evaluation.json, or evaluation_quick.json, docs/evaluation.md out of both, and the
page of `meslam report` about our runs beside the cells.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evaluated_recordings import Source, recorded, simulations
from evaluation_cell import CELL, DISAGREES, LOG
from evaluation_document import write_document
from machine import machine
from peers.__main__ import PEERS
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from simulated import program
from slam_run import HERE, SlamRun

from meslam_core.config import PRESETS

RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "evaluation"
LIBRARIES = ("open3d-cpu", "gtsam", "torch", "numpy", "evo")
BASELINE = "imap_star"
METHODS = ("meslam", *(name for name in PRESETS if name not in ("default", BASELINE)))
METHODS = (*METHODS, BASELINE, *PEERS)
QUICK_METHODS = ("meslam", BASELINE, *PEERS)
# Enough to turn by, or an alignment's lever arm could not be found.
QUICK_FRAMES, QUICK_S = ":40", 3.0
# Large networks take long, and the baseline is lost in large scenes anyway.
LARGE = (BASELINE, "paper")
LARGE_FRAMES = ":300"
SEEDS = 3
# Frames a second and seconds besides, on two cores of a server: for what is left to wait.
USUAL = {
    "meslam": (21.0, 14.0),
    "fine": (12.0, 16.0),
    "paper": (4.0, 25.0),
    "imap_star": (5.4, 30.0),
    "tsdf": (7.0, 9.0),
    "pose_graph": (8.0, 9.0),
}
SIMULATED_FRAMES_S = 18.0
# Of each run in the report.
VIEWS = 2


@dataclass(frozen=True)
class Cell:
    """A method on a recording with a seed.

    Attributes:
        source: the recording.
        job: the run.
    """

    source: Source
    job: SlamRun

    @property
    def path(self) -> Path:
        """Its result."""
        return self.job.out / CELL

    @property
    def result(self) -> dict[str, Any] | None:
        """What is known of it; None before it is done."""
        if not self.path.exists():
            return None
        return {**json.loads(self.path.read_text()), "origin": self.source.origin}

    def __str__(self) -> str:
        return f"{self.job.sequence.name}, {self.job.method}, seed {self.job.seed}"

    @property
    def command(self) -> list[str]:
        """What runs and judges it."""
        job, sequence = self.job, self.job.sequence
        command = [sys.executable, str(HERE / "evaluation_cell.py"), sequence.name]
        command += [str(sequence.recording), str(sequence.truth), job.method]
        command += ["--seed", str(job.seed), "--frames", job.frames, "--cores", str(job.cores)]
        command += ["--lever-arm"] if sequence.lever_arm else []
        command += ["--surface", str(sequence.surface)] if sequence.surface else []
        return [*command, "--out", str(job.out)]

    @property
    def frames(self) -> int:
        """How many there are, as far as that is known without opening the recording."""
        limit = int(self.job.frames.split(":")[1] or 10**9)
        return min(self.source.frames, limit)

    @property
    def usual_s(self) -> float:
        """How long it takes, roughly [s]."""
        rate, besides_s = USUAL[self.job.method]
        return self.frames / rate + besides_s


class Failures(dict[str, str]):
    """What went wrong, by cell."""


def cells_of(sources: list[Source], options: argparse.Namespace) -> list[Cell]:
    """All cells: one seed of everything, then the next."""
    cells = []
    for seed in range(max(options.seeds, options.other_seeds)):
        for source in sources:
            for method in options.methods:
                if seed >= (options.seeds if method == "meslam" else options.other_seeds):
                    continue
                frames = options.large_frames if method in LARGE else options.frames
                folder = CACHE / source.sequence.recording.stem / frames.replace(":", "-")
                out = folder / f"{method}_{seed}_{options.cores}cores"
                job = SlamRun(source.sequence, method, seed, frames, options.cores, out)
                cells.append(Cell(source, job))
    return cells


def sources_of(options: argparse.Namespace) -> list[Source]:
    """The recordings that are wanted."""
    data = os.environ.get("MESLAM_DATA")
    found = recorded(Path(data).resolve(), options.quick) if data else []
    found += simulations(CACHE.parent / "simulated", QUICK_S if options.quick else None)
    if options.recordings:
        names = {source.sequence.name for source in found}
        if unknown := set(options.recordings) - names:
            sys.exit(f"no recording {', '.join(sorted(unknown))}; there are {', '.join(names)}")
        found = [source for source in found if source.sequence.name in options.recordings]
    return found


def run(cell: Cell) -> str:
    """Do a cell; what went wrong, if anything.

    Raises:
        SystemExit: when evo and our own evaluation disagree.
    """
    cell.job.out.parent.mkdir(parents=True, exist_ok=True)
    ended = subprocess.run(cell.command, capture_output=True, text=True, check=False)
    log = cell.job.out.parent / f"{cell.job.out.name}.{LOG}"
    if ended.returncode == DISAGREES:
        sys.exit(f"{ended.stderr.strip()}\nThe command was: {shlex.join(cell.command)}")
    if ended.returncode == 0:
        return ""
    said = log.read_text().strip().splitlines() if log.exists() else []
    status = f"signal {-ended.returncode}" if ended.returncode < 0 else f"{ended.returncode}"
    return (said or ended.stderr.strip().splitlines() or [f"ended without a word ({status})"])[-1]


def run_all(cells: list[Cell], console: Console) -> Failures:
    """Do what is not done, with a bar that tells what is at work and what is left."""
    failures = Failures()
    left = [cell for cell in cells if cell.result is None]
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(TextColumn("{task.description}"), *columns, console=console) as bar:
        task = bar.add_task("", total=len(cells), completed=len(cells) - len(left))
        for number, cell in enumerate(left):
            rest_s = sum(each.usual_s for each in left[number:])
            bar.update(task, description=f"{cell}; about {duration(rest_s)} left")
            console.log(f"{len(cells) - len(left) + number + 1}/{len(cells)}: {cell}")
            cell.source.made()
            if problem := run(cell):
                failures[str(cell)] = problem
                console.log(f"{cell} failed: {problem}")
            bar.advance(task)
    return failures


def duration(seconds: float) -> str:
    """For people."""
    return f"{seconds / 3600:.1f} h" if seconds > 5400 else f"{max(1.0, seconds / 60):.0f} min"


def print_plan(cells: list[Cell], console: Console) -> None:
    """The cells, and how long what is not done will take."""
    table = Table("cell", "frames", "state", "about [s]")
    for cell in cells:
        done = cell.result is not None
        state = "done" if done else "to do"
        table.add_row(str(cell), str(cell.frames), state, "" if done else f"{cell.usual_s:.0f}")
    console.print(table)
    left = [cell for cell in cells if cell.result is None]
    missing = {cell.source.sequence.recording: cell.source for cell in left}
    simulation_s = sum(
        source.frames / SIMULATED_FRAMES_S for source in missing.values() if not source.there
    )
    whole_s = simulation_s + sum(cell.usual_s for cell in left)
    console.print(f"{len(left)} of {len(cells)} cells to do, about {duration(whole_s)} in quiet")


def write_results(cells: list[Cell], failures: Failures, options: argparse.Namespace) -> None:
    """The JSON of this mode, and the document out of both modes'."""
    options.out.mkdir(parents=True, exist_ok=True)
    arguments = shlex.join(word for word in sys.argv[1:] if word != "--quick")
    command = "make benchmark-quick" if options.quick else "make benchmark"
    result = {
        "command": f"{command} BENCHMARK_ARGS={shlex.quote(arguments)}" if arguments else command,
        "machine": machine(LIBRARIES),
        "note": options.note,
        "cells": [cell.result for cell in cells if cell.result is not None],
        "failures": failures,
    }
    name = "evaluation_quick.json" if options.quick else "evaluation.json"
    (options.out / name).write_text(json.dumps(result, indent=1) + "\n")
    write_document(options.out, options.document)


def write_page(cells: list[Cell], target: Path) -> None:
    """The report of our runs with the default settings and the first seed, side by side."""
    runs = [cell.job for cell in cells if cell.result and cell.job.method == "meslam"]
    folders = [str(job.out) for job in runs if job.seed == 0]
    if folders:
        command = [program(), "report", *folders, "--out", str(target)]
        subprocess.run([*command, "--views", str(VIEWS)], check=True)


def parsed_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few frames, one seed")
    parser.add_argument("--dry-run", action="store_true", help="list the cells")
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help="these only")
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="these only")
    parser.add_argument("--again", nargs="+", choices=METHODS, default=[], help="run these anew")
    parser.add_argument("--seeds", type=int, help="runs of MeSLAM with its default settings")
    parser.add_argument("--other-seeds", type=int, default=1, help="runs of each other method")
    parser.add_argument("--frames", metavar="A:B[:STEP]")
    parser.add_argument("--large-frames", metavar="A:B[:STEP]", help=f"of {', '.join(LARGE)}")
    parser.add_argument("--cores", type=int, default=2, help="that every run may use")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of JSON and plots")
    parser.add_argument("--document", type=Path, default=RESULTS.parent / "evaluation.md")
    parser.add_argument("--page", type=Path, help="the report of our runs; HTML")
    parser.add_argument("--note", default="", help="remark for the results")
    options = parser.parse_args()
    quick = options.quick
    options.methods = options.methods or list(QUICK_METHODS if quick else METHODS)
    options.seeds = options.seeds or (1 if quick else SEEDS)
    options.frames = options.frames or (QUICK_FRAMES if quick else ":")
    usual = QUICK_FRAMES if quick else LARGE_FRAMES
    options.large_frames = options.large_frames or usual
    page = CACHE / ("report_quick.html" if quick else "report.html")
    options.page = options.page or page
    return options


def main() -> None:
    options, console = parsed_options(), Console(markup=False)
    if "MESLAM_DATA" not in os.environ:
        console.print("MESLAM_DATA names no folder of recordings: simulated ones alone are used")
    cells = cells_of(sources_of(options), options)
    if options.dry_run:
        print_plan(cells, console)
        return
    for cell in cells:
        if cell.job.method in options.again:
            cell.path.unlink(missing_ok=True)
    failures = run_all(cells, console)
    write_results(cells, failures, options)
    console.print(f"results in {options.document}")
    write_page(cells, options.page)
    if failures:
        sys.exit(f"{len(failures)} cells failed; the same command tries them again")


if __name__ == "__main__":
    main()
