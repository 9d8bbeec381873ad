"""A computer that is far too slow: what is said of poses when most frames are skipped?

    MESLAM_DATA=folder python benchmarks/overload.py

Nothing here depends on how fast the computer is. Which frames are skipped is decided beforehand,
as it would be by a system that works on the newest frame only: after three seconds at full rate,
frames come 0.33 s apart, or 0.6 s apart, or at full rate with stalls of 1 to 2 s now and then; and
frames always wait, so that training gives way as much as it can. Recordings are the desk, where
most of the view stays the same, the room, and a piece of the building with turns and doors.

Errors are those of the online poses, after the first three seconds have been aligned with the
truth. A confident wrong pose is one with the state OK that is off by more than 20 cm and 2 % of the
way since then, as much as a path may have drifted where no place has come back.
Writes a table and JSON to docs/benchmarks/overload.*.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from machine import machine, machine_line
from relocalisation import located
from rich.console import Console
from rich.table import Table

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.relocalisation import WRONG_M, map_alignment
from meslam_core.frame_result import TrackingState
from meslam_core.odometry import make_odometry
from meslam_core.recordings.registry import open_recording
from meslam_core.se3 import inverse
from meslam_core.slam import Slam
from meslam_core.threads import limit_threads
from meslam_core.trajectory import read_tum

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "benchmarks"
LIBRARIES = ("torch", "numpy")
WARM_S = 3.0
SCENES = {"tum_fr1_xyz": (0, 500), "room": (0, 300), "building": (270, 570)}
EVERY_S = {"0.33 s apart": 0.33, "0.6 s apart": 0.6}
STALLS = "stalls of 1 to 2 s"
SCHEDULES = (*EVERY_S, STALLS)
DRIFT = 0.02
STALL_S = (1.0, 2.0)
# So long frames come at full rate between two stalls [s].
BETWEEN_S = (1.0, 3.0)
NANOSECONDS = 1e-9


def processed(stamps_s: np.ndarray, schedule: str, seed: int) -> list[int]:
    """Numbers of the frames, of increasing stamps (N,) [s], that are not skipped."""
    generator = np.random.default_rng(seed)
    chosen = [n for n, stamp in enumerate(stamps_s) if stamp - stamps_s[0] < WARM_S]
    next_s, stall_s = stamps_s[chosen[-1]], stamps_s[chosen[-1]]
    for number in range(len(chosen), len(stamps_s)):
        now_s = stamps_s[number]
        # Half a millisecond: stamps are not exact.
        if now_s < next_s - 5e-4:
            continue
        if schedule == STALLS:
            if now_s >= stall_s:
                next_s = now_s + generator.uniform(*STALL_S)
                stall_s = next_s + generator.uniform(*BETWEEN_S)
                continue
        else:
            next_s = stamps_s[chosen[-1]] + EVERY_S[schedule]
            if now_s < next_s - 5e-4:
                continue
        chosen.append(number)
    return chosen


@dataclass(frozen=True)
class Frame:
    """What was said of a frame, how far that was off [m], and the way until then [m]."""

    number: int
    state: str
    error_m: float
    way_m: float
    reason: str

    @property
    def wrong(self) -> bool:
        """Whether it is called good and is not."""
        return self.state == "OK" and self.error_m > WRONG_M + DRIFT * self.way_m


def run(scene: str, schedule: str, seed: int) -> Iterator[Frame]:
    """The frames after the first seconds, of those that are not skipped."""
    config = MeslamConfig()
    limit_threads(config.runtime.threads)
    path, truth_path = located(scene, None)
    truth, results = read_tum(truth_path), []
    first, end = SCENES[scene]
    slam = Slam(config, seed, frames_wait=lambda: True)
    odometry = make_odometry(config.odometry, config.sensor)
    with closing(open_recording(path)) as recording:
        stamps_s = recording.stamps_ns[first:end] * NANOSECONDS
        numbers = set(processed(stamps_s, schedule, seed))
        for number, frame in enumerate(recording.frames(first, end)):
            if number in numbers:
                results.append((number, slam.process(frame, odometry.process(frame))))
    slam.wait()
    online = slam.online_trajectory()
    warm = int(np.count_nonzero(online.stamps_ns - online.stamps_ns[0] < WARM_S / NANOSECONDS))
    T_truth_map = map_alignment(online.subset(np.arange(warm)), truth)
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)))
    begun_m = None
    for number, result in results[warm:]:
        nearest = int(np.abs(truth.stamps_ns - result.stamp_ns).argmin())
        begun_m = way_m[nearest] if begun_m is None else begun_m
        apart = inverse(truth.poses[nearest]) @ T_truth_map @ result.T_map_camera
        error_m, way = float(np.linalg.norm(apart[:3, 3])), float(way_m[nearest] - begun_m)
        yield Frame(first + number, result.state.name, error_m, way, result.reason)


def summary(frames: list[Frame]) -> dict[str, float]:
    """What the table says of a run."""

    def errors(*states: TrackingState) -> list[float]:
        names = [state.name for state in states]
        return [frame.error_m for frame in frames if frame.state in names]

    ok, degraded = errors(TrackingState.OK), errors(TrackingState.DEGRADED)
    return {
        "frames": len(frames),
        "ok": len(ok) / len(frames),
        "degraded": len(degraded) / len(frames),
        "lost": 1.0 - (len(ok) + len(degraded)) / len(frames),
        "worst_ok_m": max(ok, default=0.0),
        "worst_degraded_m": max(degraded, default=0.0),
        "wrong": sum(frame.wrong for frame in frames),
    }


def table(results: dict[str, dict[str, dict[str, float]]]) -> Table:
    """One row a recording and schedule."""
    shown = Table(title="When most frames are skipped")
    for column in ("recording", "frames come"):
        shown.add_column(column)
    for column in ("frames", "OK", "DEGRADED", "LOST", "off while OK [cm]", "DEGRADED [cm]"):
        shown.add_column(column, justify="right")
    shown.add_column("wrong while OK", justify="right")
    for scene, schedules in results.items():
        for schedule, entry in schedules.items():
            shares = (f"{entry[state]:.0%}" for state in ("ok", "degraded", "lost"))
            worst = (f"{100 * entry[key]:.1f}" for key in ("worst_ok_m", "worst_degraded_m"))
            frames, wrong = f"{entry['frames']:.0f}", f"{entry['wrong']:.0f}"
            shown.add_row(scene, schedule, frames, *shares, *worst, wrong)
    return shown


def main() -> None:
    """Run, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--schedules", nargs="+", choices=SCHEDULES, default=list(SCHEDULES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args()
    results: dict[str, dict[str, dict[str, float]]] = {}
    frames: dict[str, list[dict[str, object]]] = {}
    for scene in options.scenes:
        results[scene] = {}
        for schedule in options.schedules:
            found = [frame for seed in options.seeds for frame in run(scene, schedule, seed)]
            results[scene][schedule] = summary(found)
            frames[f"{scene}, {schedule}"] = [asdict(frame) for frame in found]
            print(scene, schedule, json.dumps(results[scene][schedule]), flush=True)
    described = machine(LIBRARIES)
    Console(width=140, markup=False).print(table(results))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "overload"
    seeds = " ".join(map(str, options.seeds))
    with stem.with_suffix(".txt").open("w") as file:
        file.write(f"Made by `python benchmarks/overload.py --seeds {seeds}`\n\n")
        file.write(f"{machine_line(described)}\n\n")
        Console(file=file, width=140, markup=False).print(table(results))
    written = {"machine": described, "seeds": options.seeds, "results": results, "frames": frames}
    stem.with_suffix(".json").write_text(json.dumps(written) + "\n")


if __name__ == "__main__":
    main()
