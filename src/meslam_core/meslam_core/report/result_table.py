"""The figures of runs side by side: what they reached, what it took."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from meslam_core.report.run_folder import RunFolder

Value = float | str | None
ABSENT = "–"
# What a single run's page begins with.
TILES = ("ATE, refined", "tracked", "lost", "frames a second", "stored", "per observed volume")


@dataclass(frozen=True)
class Measure:
    """A line of the table.

    Attributes:
        label, unit: for people.
        value: what a run's entries say.
        form: how a number is written.
        better: which of two is better: "less", "more", or neither.
        meaning: in a sentence.
    """

    label: str
    unit: str
    value: Callable[[Mapping[str, Any]], Value]
    form: str = ".0f"
    better: str = ""
    meaning: str = ""


@dataclass(frozen=True)
class Line:
    """A measure of all runs.

    Attributes:
        measure: of what.
        cells: texts, one a run.
        best: which cells are the best ones.
    """

    measure: Measure
    cells: list[str]
    best: list[bool]


def number(entries: Mapping[str, Any], *keys: str, scale: float = 1.0) -> float | None:
    """A number of nested entries; None where it is not there or not finite."""
    value: Any = entries
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return scale * value


def _of(*keys: str, scale: float = 1.0) -> Callable[[Mapping[str, Any]], Value]:
    return lambda entries: number(entries, *keys, scale=scale)


def _text(key: str) -> Callable[[Mapping[str, Any]], Value]:
    return lambda entries: str(entries[key]) if entries.get(key) is not None else None


def _bytes_per_m3(entries: Mapping[str, Any]) -> Value:
    size, volume = number(entries, "map_bytes"), number(entries, "observed_volume_m3")
    return size / volume if size is not None and volume else None


GROUPS: dict[str, tuple[Measure, ...]] = {
    "Trajectory": (
        Measure(
            "ATE, refined", "cm", _of("ate_rmse_m", scale=100), ".2f", "less",
            "RMSE of the positions after rigid alignment, as the path is known at the end",
        ),
        Measure(
            "ATE, online", "cm", _of("ate_online_rmse_m", scale=100), ".2f", "less",
            "the same of the poses as they were known when each frame was done",
        ),
        Measure("ATE, largest", "cm", _of("ate_max_m", scale=100), ".2f", "less"),
        Measure(
            "RPE over 1 s", "cm", _of("rpe_trans_m", scale=100), ".2f", "less",
            "RMSE of the motion within a second",
        ),
        Measure("RPE over 1 s, rotation", "°", _of("rpe_rot_deg"), ".2f", "less"),
        Measure(
            "jitter, online", "mm", _of("jitter_online_m", scale=1e3), ".1f", "less",
            "RMSE of the motion from one frame to the next",
        ),
        Measure("true path", "m", _of("path_length_m"), ".1f"),
        Measure("poses compared", "", _of("poses_compared")),
    ),
    "Tracking": (
        Measure("frames", "", _of("frames")),
        Measure("tracked", "", _of("frames_tracked")),
        Measure(
            "degraded", "", _of("frames_degraded"), ".0f", "less",
            "tracked by the odometry alone, without the map",
        ),
        Measure("lost", "", _of("frames_lost"), ".0f", "less"),
        Measure("skipped or dropped", "", _of("frames_passed_over"), ".0f", "less"),
        Measure("state at the end", "", _text("final_state")),
    ),
    "Speed and memory": (
        Measure(
            "frames a second", "/s", _of("fps"), ".1f", "more",
            "frames over the time until the last one was mapped, start-up included",
        ),
        Measure("length of the recording", "s", _of("sensor_s"), ".1f"),
        Measure("whole run", "s", _of("wall_s"), ".1f", "less", "with the last refinement"),
        Measure("largest memory", "MB", _of("peak_rss_mb"), ".0f", "less"),
    ),
    "Map": (
        Measure("stored", "kB", _of("map_bytes", scale=1e-3), ".1f", "less"),
        Measure("regions", "", _of("regions")),
        Measure("keyframes", "", _of("keyframes")),
        Measure("observed", "m³", _of("observed_volume_m3"), ".1f"),
        Measure("per observed volume", "kB/m³", lambda e: _kilo(_bytes_per_m3(e)), ".2f", "less"),
    ),
    "Surface, where the true one is known": (
        Measure(
            "mesh to true surface, median", "cm", _of("surface", "accuracy_median_m", scale=100),
            ".2f", "less",
        ),
        Measure(
            "true surface within 5 cm", "%", _of("surface", "completion_ratio", scale=100), ".1f",
            "more",
        ),
    ),
}  # fmt: skip


def result_groups(runs: Sequence[RunFolder]) -> dict[str, list[Line]]:
    """The lines that any run has something for, by group.

    Best cells are marked where several runs are of the same frames of the same recording.
    """
    entries = [_completed(run.entries) for run in runs]
    sources = {f"{each.get('recording')} {each.get('frame_range')}" for each in entries}
    comparable = len(runs) > 1 and len(sources) == 1
    groups = {}
    for name, measures in GROUPS.items():
        lines = [_line(measure, entries, comparable) for measure in measures]
        kept = [line for line in lines if any(cell != ABSENT for cell in line.cells)]
        if kept:
            groups[name] = kept
    return groups


def _line(measure: Measure, entries: Sequence[Mapping[str, Any]], comparable: bool) -> Line:
    values = [measure.value(each) for each in entries]
    cells = [_cell(value, measure.form) for value in values]
    best = [False] * len(cells)
    numbers = [value for value in values if isinstance(value, float | int)]
    if comparable and measure.better and len(set(cells)) > 1 and numbers:
        target = _cell(min(numbers) if measure.better == "less" else max(numbers), measure.form)
        best = [cell == target for cell in cells]
    return Line(measure, cells, best)


def _cell(value: Value, form: str) -> str:
    if value is None:
        return ABSENT
    return value if isinstance(value, str) else format(value, form)


def _kilo(value: Value) -> Value:
    return value / 1e3 if isinstance(value, float) else value


def _completed(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Entries with one name for what runs and nodes count under two."""
    passed = [number(entries, key) for key in ("frames_skipped", "frames_dropped")]
    counts = [count for count in passed if count is not None]
    return dict(entries) | ({"frames_passed_over": sum(counts)} if counts else {})
