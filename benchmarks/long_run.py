"""An hour of simulated driving: do memory, threads, open files or latency grow?

    python benchmarks/long_run.py

A simulated round through a building ends where it began; it is driven again and again, with stamps
that go on increasing, streamed from a recording of one round and faster than it would take. Images
are a quarter as large as a D435's and come 10 times a second, and training takes half its steps, so
that an hour takes about a third of one on two cores; nothing else is changed. The process of the
run is looked at from outside: resident memory and the kernel's record of its peak, threads, open
files, bytes of its scratch file. It tells the time of tracking and of whole frames, keyframes,
regions, and, every five minutes, the size of the map that it then saves.

After the first five minutes the peak may grow by 10 % more, and threads and open files (their
median in the last quarter) not at all; the median time of tracking in the last quarter may be a
quarter above that in the second one. Writes a table, JSON and a plot to docs/benchmarks/long_run.*;
the exit status is 1 where a limit is exceeded.
"""

from __future__ import annotations

import argparse
import json
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from machine import machine, machine_line, memory_mb
from rich.console import Console
from rich.table import Table

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import make_odometry
from meslam_core.odometry_worker import OdometryWorker
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.registry import open_recording
from meslam_core.session_map import write_map
from meslam_core.simulation.scenes import SCENES
from meslam_core.simulation.sensor import D435_CAMERA
from meslam_core.simulation.simulator import simulate
from meslam_core.simulation.writer import write_simulation
from meslam_core.slam import Slam, TrackingState
from meslam_core.threads import limit_threads

mpl.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "long_run"
LIBRARIES = ("torch", "open3d-cpu", "numpy")
LIGHTER = ("mapping.iterations=8", "mapping.keyframe_iterations=15")
FPS = 10.0
IMAGE_SCALE = 0.5
MINUTE_S = 60.0
SETTLED_S = 5 * MINUTE_S
SAVED_EVERY_S = 5 * MINUTE_S
ALLOWED_GROWTH = 0.10
ALLOWED_SLOWER = 1.25
NANOSECONDS = 1_000_000_000


def rounds(recording: Recording, duration_s: float) -> Iterator[RgbdFrame]:
    """Frames of a closed round again and again, for so long, one by one."""
    stamps_ns = recording.stamps_ns
    period_ns = int(np.median(np.diff(stamps_ns)))
    round_ns = int(stamps_ns[-1] - stamps_ns[0]) + period_ns
    done_ns = 0
    while True:
        for frame in recording.frames():
            stamp_ns = frame.stamp_ns + done_ns
            if stamp_ns - stamps_ns[0] > duration_s * NANOSECONDS:
                return
            yield replace(frame, stamp_ns=stamp_ns)
        done_ns += round_ns


@dataclass(frozen=True)
class Told:
    """What the run says of itself after some seconds of frames.

    Attributes:
        sensor_s: stamp of the latest frame since the first [s].
        frames, keyframes, regions: so far.
        degraded, lost: frames since the time before whose state was so.
        tracking_ms, tracking_p95_ms: of the frames since then, median and 95th percentile.
        frame_ms, frame_p95_ms: the same of the time from one frame to the next.
        map_bytes: of the map as it was last saved.
    """

    sensor_s: float
    frames: int
    keyframes: int
    regions: int
    degraded: int
    lost: int
    tracking_ms: float
    tracking_p95_ms: float
    frame_ms: float
    frame_p95_ms: float
    map_bytes: int


@dataclass(frozen=True)
class Sample:
    """What was seen of the run's process when it told something.

    Attributes:
        told: what.
        wall_s: since the process was started [s].
        rss_mb, peak_mb: resident now, and the most so far.
        threads, files: how many it has, has open.
        scratch_mb: what files without a name take on disk.
    """

    told: Told
    wall_s: float
    rss_mb: float
    peak_mb: float
    threads: int
    files: int
    scratch_mb: float


def follow(path: Path, minutes: float, every_s: float, overrides: Sequence[str]) -> None:
    """Drive, and report on standard output; the process that is measured."""
    config = MeslamConfig.from_overrides(overrides)
    limit_threads(config.runtime.threads)
    slam, odometry = Slam(config), make_odometry(config.odometry, config.sensor)
    tracking_ms: list[float] = []
    frame_ms: list[float] = []
    states: list[TrackingState] = []
    frames = map_bytes = 0
    saved_s = told_s = 0.0
    with closing(open_recording(path)) as recording, tempfile.TemporaryDirectory() as out:
        driven = OdometryWorker(
            rounds(recording, minutes * MINUTE_S), odometry, config.runtime.queue
        )
        first_ns = int(recording.stamps_ns[0])
        last = time.perf_counter()
        for timed in driven:
            slam.track(timed.frame, timed.odometry)
            result = slam.map()
            frames, now = frames + 1, time.perf_counter()
            tracking_ms.append(result.tracking_ms)
            frame_ms.append((now - last) * 1e3)
            states.append(result.state)
            sensor_s = (result.stamp_ns - first_ns) / NANOSECONDS
            if sensor_s - saved_s >= SAVED_EVERY_S:
                slam.wait()
                map_bytes = write_map(slam, result.stamp_ns, Path(out) / "map.meslam", None)
                saved_s = sensor_s
            if sensor_s - told_s >= every_s:
                assert slam.atlas is not None
                told = Told(
                    sensor_s,
                    frames,
                    len(slam.keyframes),
                    len(slam.atlas.regions),
                    states.count(TrackingState.DEGRADED),
                    len(states)
                    - states.count(TrackingState.DEGRADED)
                    - states.count(TrackingState.OK),
                    *np.percentile(tracking_ms, (50, 95)).tolist(),
                    *np.percentile(frame_ms, (50, 95)).tolist(),
                    map_bytes,
                )
                print(json.dumps(asdict(told)), flush=True)
                tracking_ms, frame_ms, states, told_s = [], [], [], sensor_s
            last = time.perf_counter()
        slam.wait()


def looked_at(pid: int) -> tuple[int, int, float]:
    """Threads and open files of a process, and what its files without a name take [MB]."""
    process = Path(f"/proc/{pid}")
    files = scratch = 0
    for entry in (process / "fd").iterdir():
        # It goes on meanwhile, and may close some.
        with suppress(FileNotFoundError):
            found = entry.stat()
            files += 1
            if stat.S_ISREG(found.st_mode) and not found.st_nlink:
                scratch += found.st_blocks * 512
    return len(list((process / "task").iterdir())), files, scratch / 1e6


def measure(path: Path, minutes: float, every_s: float, overrides: Sequence[str]) -> list[Sample]:
    """The run in a process of its own, looked at whenever it tells something."""
    command = [sys.executable, __file__, "--follow", str(path), "--minutes", str(minutes)]
    command += ["--every", str(every_s)]
    for override in overrides:
        command += ["--set", override]
    started, samples = time.monotonic(), []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            told, wall_s = Told(**json.loads(line)), time.monotonic() - started
            samples.append(Sample(told, wall_s, *memory_mb(process.pid), *looked_at(process.pid)))
            print(row(samples[-1]), flush=True)
    if process.returncode:
        raise SystemExit(f"the run ended with status {process.returncode}")
    return samples


def verdict(samples: Sequence[Sample]) -> dict[str, Any]:
    """What the limits are, what was seen, and whether each was kept.

    Shorter runs count what comes after their first half as settled.
    """
    end_s = samples[-1].told.sensor_s
    settled_s = min(SETTLED_S, 0.5 * end_s)
    settled = next(i for i, each in enumerate(samples) if each.told.sensor_s >= settled_s)
    before = samples[: settled + 1]
    quarters = [
        [s.told.tracking_ms for s in samples if n <= 4 * s.told.sensor_s / end_s <= n + 1]
        for n in (1, 3)
    ]
    second_ms, last_ms = (float(np.median(quarter)) for quarter in quarters)
    growth = samples[-1].peak_mb / samples[settled].peak_mb - 1.0
    # What leaks stays: a file that is open while the map is saved does not.
    late = [each for each in samples if 4 * each.told.sensor_s >= 3 * end_s]
    threads, files = (
        [max(getattr(s, name) for s in before), int(np.median([getattr(s, name) for s in late]))]
        for name in ("threads", "files")
    )
    return {
        "minutes": end_s / MINUTE_S,
        "frames": samples[-1].told.frames,
        "settled_s": settled_s,
        "settled_peak_mb": samples[settled].peak_mb,
        "peak_mb": samples[-1].peak_mb,
        "growth": growth,
        "threads": threads,
        "files": files,
        "tracking_ms": [second_ms, last_ms],
        "lost": sum(each.told.lost for each in samples),
        "kept": {
            "memory": growth <= ALLOWED_GROWTH,
            "threads": threads[1] <= threads[0],
            "files": files[1] <= files[0],
            "latency": last_ms <= ALLOWED_SLOWER * second_ms,
        },
    }


def sentence(found: dict[str, Any]) -> str:
    """The same in words."""
    exceeded = [name for name, kept in found["kept"].items() if not kept]
    return (
        f"{found['minutes']:.0f} min, {found['frames']} frames: peak {found['peak_mb']:.0f} MB, "
        f"{100 * found['growth']:+.1f} % over the {found['settled_peak_mb']:.0f} MB after "
        f"{found['settled_s'] / MINUTE_S:.0f} min (allowed: {100 * ALLOWED_GROWTH:.0f} %); "
        f"threads {found['threads'][0]}, then {found['threads'][1]}; open files "
        f"{found['files'][0]}, then {found['files'][1]}; tracking {found['tracking_ms'][0]:.1f} ms "
        f"in the second quarter, {found['tracking_ms'][1]:.1f} in the last; {found['lost']} frames "
        f"lost. " + (f"Exceeded: {', '.join(exceeded)}." if exceeded else "All limits kept.")
    )


def row(sample: Sample) -> str:
    """A sample on one line, while the run goes on."""
    told = sample.told
    return (
        f"{told.sensor_s / MINUTE_S:5.1f} min {told.frames} frames, {told.keyframes} keyframes, "
        f"{told.regions} regions, {sample.rss_mb:.0f} MB (peak {sample.peak_mb:.0f}), "
        f"{sample.threads} threads, {sample.files} files, {told.tracking_ms:.1f} ms"
    )


def table_of(samples: Sequence[Sample]) -> Table:
    """One row every so often, about 25 in all."""
    table = Table(title="An hour of simulated driving, round after round")
    columns = ("min", "frames", "keyframes", "regions", "map [kB]", "RSS [MB]", "peak", "threads")
    for column in (*columns, "files", "scratch [MB]", "tracking [ms]", "p95", "frame [ms]", "p95"):
        table.add_column(column, justify="right")
    for sample in [*samples[:: max(1, len(samples) // 25)], samples[-1]]:
        told = sample.told
        table.add_row(
            f"{told.sensor_s / MINUTE_S:.1f}",
            *(str(count) for count in (told.frames, told.keyframes, told.regions)),
            f"{told.map_bytes / 1e3:.0f}" if told.map_bytes else "-",
            f"{sample.rss_mb:.0f}",
            f"{sample.peak_mb:.0f}",
            str(sample.threads),
            str(sample.files),
            f"{sample.scratch_mb:.0f}",
            f"{told.tracking_ms:.1f}",
            f"{told.tracking_p95_ms:.1f}",
            f"{told.frame_ms:.1f}",
            f"{told.frame_p95_ms:.1f}",
        )
    return table


def plot(samples: Sequence[Sample], path: Path) -> None:
    """Memory, keyframes, latency, and threads with open files over the time of the frames."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), sharex=True, layout="constrained")
    minutes = [each.told.sensor_s / MINUTE_S for each in samples]
    curves: list[list[tuple[str, list[float]]]] = [
        [
            ("resident [MB]", [s.rss_mb for s in samples]),
            ("peak [MB]", [s.peak_mb for s in samples]),
        ],
        [("keyframes", [s.told.keyframes for s in samples])],
        [
            ("tracking, median [ms]", [s.told.tracking_ms for s in samples]),
            ("tracking, p95 [ms]", [s.told.tracking_p95_ms for s in samples]),
        ],
        [("threads", [s.threads for s in samples]), ("open files", [s.files for s in samples])],
    ]
    for axis, lines in zip(axes.flat, curves, strict=True):
        for label, values in lines:
            axis.plot(minutes, values, label=label)
        axis.set_ylim(bottom=0)
        axis.legend(loc="lower right")
    for axis in axes[1]:
        axis.set_xlabel("time of the frames [min]")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def driven_round(scene: str) -> Path:
    """A recording of one round of a scene, made where it is not there yet."""
    path = CACHE / f"{scene}.mcap"
    if not path.exists():
        camera = D435_CAMERA.scaled(IMAGE_SCALE)
        write_simulation(simulate(scene, camera=camera, fps=FPS), path)
    return path


def main() -> None:
    """Run, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", choices=SCENES, default="building")
    parser.add_argument("--minutes", type=float, default=60.0, help="of frames")
    parser.add_argument("--every", type=float, default=10.0, help="seconds of frames a sample")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--follow", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.follow is not None:
        follow(options.follow, options.minutes, options.every, options.set)
        return
    settings = [*LIGHTER, *options.set]
    samples = measure(driven_round(options.scene), options.minutes, options.every, settings)
    found, described = verdict(samples), machine(LIBRARIES)
    Console(width=140, markup=False).print(table_of(samples), sentence(found))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "long_run"
    with stem.with_suffix(".txt").open("w") as file:
        command = f"python benchmarks/long_run.py --scene {options.scene}"
        file.write(f"Made by `{command} --minutes {options.minutes:g}`\n\n")
        file.write(f"{machine_line(described)}\n\n")
        Console(file=file, width=140, markup=False).print(table_of(samples))
        file.write(sentence(found) + "\n")
    plot(samples, stem.with_suffix(".png"))
    names = [field.name for field in fields(Sample) if field.name != "told"]
    result = {
        "machine": described,
        "scene": options.scene,
        "settings": settings,
        "summary": found,
        "samples": [
            {**asdict(each.told), **{name: getattr(each, name) for name in names}}
            for each in samples
        ],
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    sys.exit(not all(found["kept"].values()))


if __name__ == "__main__":
    main()
