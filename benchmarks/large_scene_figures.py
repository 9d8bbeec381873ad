"""Tables and pictures of the benchmark of a large scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from meslam_core.trajectory import Trajectory

mpl.use("Agg")
from pathlib import Path

from matplotlib import pyplot as plt

COLORS = {
    "meslam": "tab:blue",
    "no_loops": "tab:cyan",
    "no_odometry": "tab:orange",
    "no_continuation": "tab:green",
    "no_regions": "tab:purple",
    "imap_star": "tab:red",
}
CENTIMETRES = 100.0
SMOOTHED_FRAMES = 30


@dataclass(frozen=True)
class Path2d:
    """What is drawn of a run.

    Attributes:
        estimate, truth: refined and true poses, aligned.
        along_m: (N,) length of the true path up to each [m].
        online_m: (N,) error of the poses as they were known live [m].
        notes: of the frames, by column.
    """

    estimate: Trajectory
    truth: Trajectory
    along_m: NDArray[np.float64]
    online_m: NDArray[np.float64]
    notes: Mapping[str, NDArray[Any]]


def tables(summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> list[Table]:
    """Of the paths and maps; of memory and time; of the regions that were come back to."""
    return [
        _paths_and_maps(summary, names),
        _memory_and_time(summary, names),
        _revisits(summary, names),
    ]


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title)
    for column in columns:
        table.add_column(column, justify="left" if column == "method" else "right")
    return table


def _paths_and_maps(summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Table:
    table = _table(
        "Path and map",
        "method",
        "path [m]",
        "tracked",
        "regions",
        "ATE refined [cm]",
        "of path",
        "ATE online [cm]",
        "of path",
        "map error a region, median / worst [cm]",
        "known",
        "seam, blended / nearest alone [cm]",
    )
    for method, figures in summary.items():
        error, seams = figures["map_error_m"], figures["seams"]
        table.add_row(
            names[method],
            f"{figures['path_m']:.1f}",
            f"{figures['frames_tracked']}/{figures['frames']}",
            str(figures["regions"]),
            _centimetres(figures["ate_m"]),
            f"{figures['ate_of_path']:.3%}",
            _centimetres(figures["ate_online_m"]),
            f"{figures['ate_online_of_path']:.3%}",
            f"{_centimetres(error['median'])} / {_centimetres(error['worst'])}",
            f"{error['known']:.1%}",
            "-"
            if seams is None
            else f"{_centimetres(seams['blended_median_m'])} / "
            f"{_centimetres(seams['nearest_median_m'])}",
        )
    return table


def _memory_and_time(summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Table:
    table = _table(
        "Memory and time",
        "method",
        "frames/s",
        "odometry [ms]",
        "tracking [ms]",
        "mapping [ms]",
        "refining [s]",
        "peak, 1/3 of path [MB]",
        "peak, end [MB]",
        "growth",
        "peak with refining [MB]",
        "map [kB]",
    )
    for method, figures in summary.items():
        memory = figures["memory"]
        stages = (figures["stage_ms"][name] for name in ("odometry", "tracking", "mapping"))
        table.add_row(
            names[method],
            f"{figures['fps']:.1f}",
            *(f"{stage['median']:.1f} (p95 {stage['p95']:.0f})" for stage in stages),
            f"{figures['wall_s'] - figures['online_s']:.0f}",
            f"{memory['third_mb']:.0f}",
            f"{memory['end_mb']:.0f}",
            f"{memory['growth']:+.1%}",
            f"{figures['peak_mb']:.0f}",
            f"{figures['map_bytes'] / 1e3:.0f}",
        )
    return table


def _revisits(summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Table:
    table = _table(
        "Regions come back to: median error of their map [cm]",
        "method",
        "region",
        "others between",
        "when left",
        "come back to",
        "left again",
    )
    for method, figures in summary.items():
        for visit in figures["revisits"]:
            table.add_row(
                names[method],
                str(tuple(visit["region"])),
                str(visit["others"]),
                _centimetres(visit["left_m"]),
                *(_changed(visit[key], visit["left_m"]) for key in ("return_m", "left_again_m")),
            )
    return table


def _changed(error_m: float | None, before_m: float) -> str:
    """An error with how much larger it is than before."""
    if error_m is None:
        return "-"
    return f"{_centimetres(error_m)} ({error_m / before_m - 1.0:+.0%})"


def _centimetres(metres: float) -> str:
    return f"{CENTIMETRES * metres:.2f}"


def plot(
    summary: Mapping[str, Mapping[str, Any]],
    paths: Mapping[str, Path2d],
    names: Mapping[str, str],
    target: Path,
) -> None:
    """The paths from above; errors, time and memory along the path; the map's error a region."""
    figure = plt.figure(figsize=(13, 15), layout="constrained")
    grid = figure.add_gridspec(4, 2, height_ratios=[1.6, 1, 1, 1])
    above = figure.add_subplot(grid[0, :])
    _draw_paths(above, paths, names)
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    _draw_errors(figure.add_subplot(grid[1, :]), paths)
    _draw_map_errors(figure.add_subplot(grid[2, 0]), summary)
    _draw_times(figure.add_subplot(grid[2, 1]), paths)
    _draw_memory(figure.add_subplot(grid[3, 0]), paths)
    _draw_regions(figure.add_subplot(grid[3, 1]), paths)
    figure.savefig(target, dpi=100)
    plt.close(figure)


def _draw_paths(axis: Any, paths: Mapping[str, Path2d], names: Mapping[str, str]) -> None:
    longest = max(paths.values(), key=lambda path: len(path.truth))
    across, up = widest(longest.truth.positions)
    true = longest.truth.positions
    axis.plot(true[:, across], true[:, up], color="0.7", linewidth=4, label="truth")
    for method, path in paths.items():
        positions = path.estimate.positions
        axis.plot(
            positions[:, across],
            positions[:, up],
            color=COLORS[method],
            linewidth=1.2,
            label=names[method],
        )
    # A method that is lost may be anywhere; the picture stays with the truth.
    axis.set_xlim(true[:, across].min() - 2, true[:, across].max() + 2)
    axis.set_ylim(true[:, up].min() - 2, true[:, up].max() + 2)
    axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal")


def widest(positions: NDArray[np.floating]) -> tuple[int, int]:
    """The two axes along which positions (N, 3) extend most, in their order."""
    extent = np.ptp(positions, axis=0)
    first, second = sorted(np.argsort(extent)[1:].tolist())
    return first, second


def _draw_errors(axis: Any, paths: Mapping[str, Path2d]) -> None:
    for method, path in paths.items():
        refined = np.linalg.norm(path.estimate.positions - path.truth.positions, axis=1)
        axis.plot(path.along_m, CENTIMETRES * refined, color=COLORS[method], lw=1.2)
        axis.plot(path.along_m, CENTIMETRES * path.online_m, ":", color=COLORS[method], lw=0.9)
    axis.set(
        xlabel="path [m]",
        ylabel="error [cm]",
        yscale="log",
        title="error of the pose: refined, and as known live (dotted)",
    )
    axis.grid(alpha=0.3)


def _draw_map_errors(axis: Any, summary: Mapping[str, Mapping[str, Any]]) -> None:
    for method, figures in summary.items():
        errors = np.sort(list(figures["map_error_m"]["boxes"].values()))
        share = np.arange(1, len(errors) + 1) / len(errors)
        axis.step(CENTIMETRES * errors, share, where="post", color=COLORS[method])
    axis.set(
        xlabel="median error of the map in a region's box [cm]",
        ylabel="share of regions",
        title="map error a region",
        ylim=(0, 1),
    )
    axis.grid(alpha=0.3)


def _draw_times(axis: Any, paths: Mapping[str, Path2d]) -> None:
    kernel = np.ones(SMOOTHED_FRAMES) / SMOOTHED_FRAMES
    for method, path in paths.items():
        frame_ms = 1e3 * np.diff(path.notes["wall_s"])
        if len(frame_ms) >= SMOOTHED_FRAMES:
            smooth = np.convolve(frame_ms, kernel, "valid")
            axis.plot(path.along_m[SMOOTHED_FRAMES:], smooth, color=COLORS[method], lw=1)
    axis.set(
        xlabel="path [m]",
        ylabel="time a frame [ms]",
        yscale="log",
        title=f"time a frame, mean of {SMOOTHED_FRAMES}",
    )
    axis.grid(alpha=0.3)


def _draw_memory(axis: Any, paths: Mapping[str, Path2d]) -> None:
    for method, path in paths.items():
        axis.plot(path.along_m, path.notes["rss_mb"], color=COLORS[method], lw=1)
    axis.set(xlabel="path [m]", ylabel="resident memory [MB]", title="memory")
    axis.set_ylim(bottom=0)
    axis.grid(alpha=0.3)


def _draw_regions(axis: Any, paths: Mapping[str, Path2d]) -> None:
    for method, path in paths.items():
        axis.plot(path.along_m, path.notes["regions"], color=COLORS[method], lw=1.5)
        axis.plot(path.along_m, path.notes["resting"], ":", color=COLORS[method], lw=1.2)
    axis.set(xlabel="path [m]", ylabel="regions", title="regions, and those at rest (dotted)")
    axis.grid(alpha=0.3)
