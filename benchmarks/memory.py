"""Memory of a run over time, on a recording looped forth and back.

    MESLAM_DATA=folder python benchmarks/memory.py

`meslam_core.pipeline.run` runs in a process of its own, as `meslam run` does it, on frames that are
decoded when they are due and never kept; time stamps go on increasing. The resident set of that
process and the kernel's record of its largest are read while it runs, up to its very end
(refinement and writing of the map included). The target is a peak within 10 % of that after one
minute of frames. Writes a table, JSON and a plot to docs/benchmarks/memory.*.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from machine import machine, machine_line, memory_mb
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.pipeline import RunOptions, run
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.registry import open_recording
from meslam_core.slam import FrameResult

mpl.use("Agg")
from matplotlib import pyplot as plt

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "benchmarks"
LIBRARIES = ("torch", "open3d-cpu", "numpy")
MINUTE_S = 60.0
ALLOWED_GROWTH = 0.10
FRAMES_A_SAMPLE = 15
NANOSECONDS = 1_000_000_000


class LoopedRecording:
    """A recording played forth and back, again and again, for as long as wanted.

    The pause between two frames is the one that the recording has between them. Frames are read
    one by one, so the recording should be of image files; others seek for every frame.

    Args:
        recording: of at least two frames.
        duration_s: between the first and the last stamp, at most [s].
    """

    def __init__(self, recording: Recording, duration_s: float) -> None:
        self.name = recording.name
        self.path = recording.path
        self.format = recording.format
        self.topics = recording.topics
        self._recording = recording
        self._numbers, self._stamps_ns = loop(recording.stamps_ns, duration_s)

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the recording."""
        return self._recording.camera

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of all frames [ns], strictly increasing."""
        return self._stamps_ns

    def __len__(self) -> int:
        return len(self._numbers)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """The frames `start:stop:step`; see `Recording.frames`."""
        chosen = slice(start, stop, step)
        for number, stamp_ns in zip(self._numbers[chosen], self._stamps_ns[chosen], strict=True):
            (frame,) = self._recording.frames(int(number), int(number) + 1)
            yield replace(frame, stamp_ns=int(stamp_ns))

    def close(self) -> None:
        """Close the recording."""
        self._recording.close()


def loop(
    stamps_ns: NDArray[np.int64], duration_s: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers and new stamps [ns] of frames played forth and back, the ends once each.

    Args:
        stamps_ns: (N,) increasing, N at least 2.
        duration_s: of the result, at most [s].
    """
    count = len(stamps_ns)
    lap = np.concatenate([np.arange(count), np.arange(count - 2, 0, -1)])
    lap_ns = 2 * int(stamps_ns[-1] - stamps_ns[0])
    laps = int(duration_s * NANOSECONDS // lap_ns) + 1
    numbers = np.append(np.tile(lap, laps), 0)
    pauses_ns = np.abs(np.diff(stamps_ns[numbers]))
    looped_ns = stamps_ns[0] + np.concatenate([[0], np.cumsum(pauses_ns)])
    kept = looped_ns - stamps_ns[0] <= duration_s * NANOSECONDS
    return numbers[kept], looped_ns[kept]


@dataclass(frozen=True)
class Sample:
    """Memory of the process at one moment.

    Attributes:
        stage: "frames" or a later one of the run, as `RunProgress` names it.
        wall_s: since the process was started [s].
        sensor_s: stamp of the latest frame since the first [s].
        frames, keyframes: so far.
        rss_mb: resident now; peak_mb: the most so far.
    """

    stage: str
    wall_s: float
    sensor_s: float
    frames: int
    keyframes: int
    rss_mb: float
    peak_mb: float


class Reporter:
    """`RunProgress` that writes a line of JSON for every second of frames, and for every stage."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._latest: dict[str, Any] = {"sensor_s": 0.0, "frames": 0, "keyframes": 0}

    def started(self, frames: int) -> None:
        """Nothing."""

    def processed(self, offered: int, result: FrameResult) -> None:
        """Count the frame, and tell now and then."""
        if self._first_ns is None:
            self._first_ns = result.stamp_ns
        self._latest = {
            "sensor_s": (result.stamp_ns - self._first_ns) / NANOSECONDS,
            "frames": self._latest["frames"] + 1,
            "keyframes": self._latest["keyframes"] + result.is_keyframe,
        }
        if self._latest["frames"] % FRAMES_A_SAMPLE == 1:
            self._tell("frames")

    def stage(self, name: str) -> None:
        """The stage is about to begin."""
        self._tell(name)

    def _tell(self, stage: str) -> None:
        print(json.dumps({"stage": stage, **self._latest}), flush=True)


def follow(path: Path, minutes: float, overrides: Sequence[str]) -> None:
    """Run on the looped recording and report on standard output; the process that is measured."""
    recording = LoopedRecording(open_recording(path), minutes * MINUTE_S)
    reporter = Reporter()
    config = MeslamConfig.from_overrides(overrides)
    with tempfile.TemporaryDirectory() as out:
        run(recording, config, Path(out) / "run", RunOptions(), reporter)
        reporter.stage("done")
    recording.close()


def measure(path: Path, minutes: float, overrides: Sequence[str]) -> list[Sample]:
    """Memory of the run in a process of its own, read whenever it reports."""
    command = [sys.executable, __file__, str(path), "--follow", "--minutes", str(minutes)]
    for override in overrides:
        command += ["--set", override]
    started = time.monotonic()
    samples = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            rss_mb, peak_mb = memory_mb(process.pid)
            wall_s = time.monotonic() - started
            samples.append(
                Sample(**json.loads(line), wall_s=wall_s, rss_mb=rss_mb, peak_mb=peak_mb)
            )
    if process.returncode:
        raise SystemExit(f"the run ended with status {process.returncode}")
    return samples


def peak_after(samples: Sequence[Sample], sensor_s: float) -> float:
    """The largest memory so far when frames of so many seconds were done [MB].

    Raises:
        ValueError: the run was shorter.
    """
    for sample in samples:
        if sample.sensor_s >= sensor_s:
            return sample.peak_mb
    raise ValueError(f"the run ended before {sensor_s:g} s of frames")


def summary(samples: Sequence[Sample]) -> dict[str, float]:
    """What the curve says: the peaks, and how much a frame adds after the first minute."""
    frames = [sample for sample in samples if sample.stage == "frames"]
    last = frames[-1]
    reference_s = min(MINUTE_S, 0.5 * last.sensor_s)
    later = [sample for sample in frames if sample.sensor_s >= reference_s]
    slope = np.polyfit([s.frames for s in later], [s.rss_mb for s in later], 1)[0]
    reference_mb = peak_after(samples, reference_s)
    peak_mb = max(sample.peak_mb for sample in samples)
    return {
        "minutes": last.sensor_s / MINUTE_S,
        "frames": last.frames,
        "keyframes": last.keyframes,
        "reference_s": reference_s,
        "reference_peak_mb": reference_mb,
        "peak_mb": peak_mb,
        "peak_of_frames_mb": last.peak_mb,
        "growth": peak_mb / reference_mb - 1.0,
        "growth_kb_a_frame": 1000.0 * float(slope),
    }


def table_of(samples: Sequence[Sample], found: dict[str, float]) -> Table:
    """One row a minute, and one a stage."""
    table = Table(title="Memory of a run on a recording looped forth and back")
    for column in ("stage", "sensor [min]", "frames", "keyframes", "RSS [MB]", "peak [MB]"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    shown_minute = -1
    for sample in samples:
        minute = int(sample.sensor_s // MINUTE_S)
        if sample.stage != "frames" or minute > shown_minute:
            shown_minute = max(shown_minute, minute)
            table.add_row(
                sample.stage,
                f"{sample.sensor_s / MINUTE_S:.1f}",
                str(sample.frames),
                str(sample.keyframes),
                f"{sample.rss_mb:.0f}",
                f"{sample.peak_mb:.0f}",
            )
    return table


def verdict(found: dict[str, float]) -> str:
    """The figure that decides, in a sentence."""
    return (
        f"peak {found['peak_mb']:.0f} MB, {100 * found['growth']:+.1f} % over the "
        f"{found['reference_peak_mb']:.0f} MB after {found['reference_s']:.0f} s "
        f"(allowed: {100 * ALLOWED_GROWTH:.0f} %); "
        f"{found['growth_kb_a_frame']:.1f} kB a frame from then on"
    )


def plot(samples: Sequence[Sample], found: dict[str, float], path: Path) -> None:
    """Memory and keyframes over the time of the frames."""
    figure, axis = plt.subplots(figsize=(9, 5), layout="constrained")
    # What follows the last frame has no sensor time: it goes on with wall time.
    frames = [sample for sample in samples if sample.stage == "frames"]
    end = frames[-1]
    minutes = [(s.sensor_s + max(0.0, s.wall_s - end.wall_s)) / MINUTE_S for s in samples]
    axis.plot(minutes, [s.rss_mb for s in samples], color="tab:blue", label="resident")
    axis.plot(minutes, [s.peak_mb for s in samples], "--", color="tab:blue", label="peak so far")
    limit_mb = (1.0 + ALLOWED_GROWTH) * found["reference_peak_mb"]
    axis.axhline(limit_mb, color="tab:red", lw=1, label="allowed")
    axis.axvline(end.sensor_s / MINUTE_S, color="0.7", lw=1)
    axis.set(xlabel="time of the frames, then of refinement [min]", ylabel="memory [MB]")
    axis.set_ylim(bottom=0)
    other = axis.twinx()
    other.plot(minutes, [s.keyframes for s in samples], color="tab:gray", lw=1)
    other.set_ylabel("keyframes", color="tab:gray")
    axis.legend(loc="lower right")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "recording", type=Path, nargs="?", help="by default tum_fr1_xyz below MESLAM_DATA"
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="of frames")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--follow", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    path = options.recording
    if path is None:
        if "MESLAM_DATA" not in os.environ:
            parser.error("name a recording, or the folder of recordings in MESLAM_DATA")
        path = Path(os.environ["MESLAM_DATA"]) / "tum_fr1_xyz"
    if options.follow:
        follow(path, options.minutes, options.set)
        return
    samples = measure(path, options.minutes, options.set)
    found = summary(samples)
    described = machine(LIBRARIES)
    table = table_of(samples, found)
    console = Console(markup=False)
    console.print(table)
    console.print(verdict(found))
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "memory"
    with stem.with_suffix(".txt").open("w") as file:
        command = f"python benchmarks/memory.py --minutes {options.minutes:g}"
        file.write(f"Made by `{command}` on {path.name}\n\n{machine_line(described)}\n\n")
        Console(file=file, width=120, markup=False).print(table)
        file.write(verdict(found) + "\n")
    plot(samples, found, stem.with_suffix(".png"))
    result = {
        "machine": described,
        "recording": path.name,
        "settings": options.set,
        "summary": found,
        "samples": [asdict(sample) for sample in samples],
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
