"""Cameras that are covered or carried elsewhere: are they found again, and never in a wrong place?

    MESLAM_DATA=folder python benchmarks/relocalisation.py

Each recording is mapped once; then the session goes on with one disturbance after another, and
with the map that the ones before have left. Kidnapped: from one frame to the next the camera is
somewhere else on its path, at least 3 s of the recording away. Covered: it sees nothing for 5 s,
then somewhere on its path again. Unseen: the same, but what it sees then is the mirror image, with
all that is flat and symmetric in place and nothing else: nobody has ever been there.

Found means that the state is OK within 2 s of sensor time from the first frame that shows
something, with an error of at most 5 cm and 3 degrees; a confident wrong frame is one with the
state OK and an error of more than 20 cm, or a place that does not exist. Errors are those of the
online poses against the true ones, after the mapped trajectory has been aligned with the truth.
Writes a table and JSON to docs/benchmarks/relocalisation.*.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine, machine_line
from rich.console import Console
from rich.table import Table
from simulated import simulated

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.relocalisation import (
    COVERED,
    KIDNAPPED,
    UNSEEN,
    Disturbed,
    Outcome,
    carried,
)
from meslam_core.odometry import make_odometry
from meslam_core.recordings.registry import open_recording
from meslam_core.slam import Slam
from meslam_core.threads import limit_threads
from meslam_core.trajectory import read_tum

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "relocalisation"
LIBRARIES = ("torch", "numpy")
KINDS = (KIDNAPPED, COVERED, UNSEEN)
TRIALS = 20
CARRIED_S = 3.0
# A kidnapped camera is carried at least so far, an angle of a radian counting as a metre.
CARRIED_M = 0.3
SEEN_S = 2.4
LIMIT_S = 2.0


@dataclass(frozen=True)
class Scene:
    """A recording to be mapped.

    Attributes:
        options: with which `meslam simulate` makes it; None for a recording.
        frames: mapped of it; None for all.
    """

    options: tuple[str, ...] | None
    frames: int | None = None


SCENES = {
    "tum_fr1_xyz": Scene(None),
    "room": Scene(("--duration", "20", "--seed", "1")),
    "building": Scene(("--duration", "40"), 600),
}


def located(name: str, given: Path | None) -> tuple[Path, Path]:
    """A scene's recording and its true poses."""
    options = SCENES[name].options
    if options is None:
        path = given or Path(os.environ.get("MESLAM_DATA", "")) / name
        if not path.is_dir():
            raise SystemExit(f"{path} is not there; say where {name} is: --recording, MESLAM_DATA")
        return path, path / "groundtruth.txt"
    path = given or simulated(name, CACHE / f"{name}.mcap", *options)
    return path, path.with_suffix(".truth.txt")


def outcomes(
    path: Path, truth: Path, frames: int | None, trials: int, seed: int
) -> Iterator[Outcome]:
    """Map a recording, then disturb the camera, `trials` times in each way."""
    config = MeslamConfig()
    limit_threads(config.runtime.threads)
    slam, odometry = Slam(config, seed), make_odometry(config.odometry, config.sensor)
    true = read_tum(truth)
    with closing(open_recording(path)) as recording:
        stamps = []
        for frame in recording.frames(0, frames):
            slam.process(frame, odometry.process(frame))
            stamps.append(frame.stamp_ns)
        slam.wait()
        nearest = [int(np.abs(true.stamps_ns - stamp).argmin()) for stamp in stamps]
        session = Disturbed(slam, odometry, recording, true)
        seen, away = (round(s * session.per_second) for s in (SEEN_S, CARRIED_S))
        for number, kind in enumerate(KINDS):
            least_m = CARRIED_M if kind == KIDNAPPED else 0.0
            places = true.poses[nearest]
            for trial in carried(
                kind, trials, places, seen, away, len(KINDS) * seed + number, least_m=least_m
            ):
                yield session.run(trial)


def summary(found: Sequence[Outcome]) -> dict[str, Any]:
    """What the table says of the trials of one kind."""
    times = [each.found_s for each in found if each.found_s is not None]
    errors_m = [each.error_m for each in found if each.found_s is not None]
    errors_deg = [np.rad2deg(each.error_rad) for each in found if each.found_s is not None]
    return {
        "trials": len(found),
        "median_jump_m": float(np.median([each.jump_m for each in found])),
        "median_jump_deg": float(np.median([np.rad2deg(each.jump_rad) for each in found])),
        "found": sum(each.within(LIMIT_S) for each in found),
        "called_found": len(times),
        "median_s": float(np.median(times)) if times else None,
        "max_s": max(times, default=None),
        "median_error_m": float(np.median(errors_m)) if times else None,
        "max_error_m": max(errors_m, default=None),
        "median_error_deg": float(np.median(errors_deg)) if times else None,
        "max_error_deg": float(max(errors_deg)) if times else None,
        "wrong_frames": sum(each.wrong for each in found),
    }


def table(results: dict[str, dict[str, dict[str, Any]]]) -> Table:
    """One row a scene and kind."""
    shown = Table(title="Cameras that are covered or carried elsewhere")
    columns = ("jump [m]", "[deg]", "found", "after [s]", "most", "off [cm]", "most", "[deg]")
    for column in ("recording", "camera", *columns, "most", "wrong frames"):
        shown.add_column(column, justify="left" if column in ("recording", "camera") else "right")
    for scene, kinds in results.items():
        for kind, entry in kinds.items():
            found = f"{entry['found']} of {entry['trials']}"
            shown.add_row(
                scene,
                kind,
                f"{entry['median_jump_m']:.2f}",
                f"{entry['median_jump_deg']:.0f}",
                found if kind != UNSEEN else f"{entry['called_found']} of {entry['trials']}",
                *(_number(entry[key], 2) for key in ("median_s", "max_s")),
                *(_number(entry[key], 1, 100.0) for key in ("median_error_m", "max_error_m")),
                *(_number(entry[key], 1) for key in ("median_error_deg", "max_error_deg")),
                str(entry["wrong_frames"]),
            )
    return shown


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"


def as_entry(outcome: Outcome) -> dict[str, Any]:
    """An outcome for JSON."""
    trial = outcome.trial
    return {
        "kind": trial.kind,
        "back": trial.back,
        "jump_m": outcome.jump_m,
        "jump_deg": float(np.rad2deg(outcome.jump_rad)),
        "found_s": outcome.found_s,
        "error_m": None if outcome.found_s is None else outcome.error_m,
        "error_deg": None if outcome.found_s is None else float(np.rad2deg(outcome.error_rad)),
        "worst_m": outcome.worst_m,
        "wrong": outcome.wrong,
        "states": "".join(str(int(state)) for state in outcome.states),
    }


def main() -> None:
    """Run, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--recording", nargs="+", default=[], metavar="SCENE=PATH")
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each kind and scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args()
    given = {name: Path(path) for name, _, path in (s.partition("=") for s in options.recording)}
    results: dict[str, dict[str, dict[str, Any]]] = {}
    trials: dict[str, list[dict[str, Any]]] = {}
    for name in options.scenes:
        path, truth = located(name, given.get(name))
        found = []
        for outcome in outcomes(path, truth, SCENES[name].frames, options.trials, options.seed):
            found.append(outcome)
            print(name, json.dumps(as_entry(outcome)), flush=True)
        results[name] = {k: summary([o for o in found if o.trial.kind == k]) for k in KINDS}
        trials[name] = [as_entry(each) for each in found]
    described = machine(LIBRARIES)
    console = Console(width=140, markup=False)
    console.print(table(results))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "relocalisation"
    with stem.with_suffix(".txt").open("w") as file:
        command = (
            f"python benchmarks/relocalisation.py --trials {options.trials} --seed {options.seed}"
        )
        file.write(f"Made by `{command}`\n\n{machine_line(described)}\n\n")
        Console(file=file, width=140, markup=False).print(table(results))
    written = {"machine": described, "seed": options.seed, "results": results, "trials": trials}
    stem.with_suffix(".json").write_text(json.dumps(written, indent=1) + "\n")


if __name__ == "__main__":
    main()
