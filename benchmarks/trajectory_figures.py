"""Table and pictures of the trajectory benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from rich.table import Table

from meslam_core.trajectory import Trajectory

mpl.use("Agg")
from matplotlib import pyplot as plt

COLORS = {"meslam": "tab:blue", "tsdf": "tab:orange", "pose_graph": "tab:green"}
CENTIMETRES = 100.0
# Bars end here; their labels tell the error of a method that is lost.
HIGHEST_BAR_CM = 12.0


@dataclass(frozen=True)
class Path3d:
    """Aligned refined positions of one run and the true ones, (N, 3) [m]."""

    estimate: np.ndarray
    truth: Trajectory


def spread(runs: Sequence[Mapping[str, Any]], key: str) -> dict[str, float]:
    """Median, smallest and largest of a figure over runs."""
    values = [float(run[key]) for run in runs]
    return {
        "median": float(np.median(values)),
        "min": float(np.min(values)),
        "max": float(np.max(values)),
    }


def table_of(summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Table:
    """One row a recording and method."""
    table = Table(title="Trajectories: median of the runs, and their range")
    for column in ("recording", "method"):
        table.add_column(column)
    for column in (
        "tracked",
        "ATE refined [cm]",
        "ATE online [cm]",
        "jitter, RMS [cm]",
        "jitter, median [cm]",
        "frames/s",
        "peak [MB]",
    ):
        table.add_column(column, justify="right")
    for recording, methods in summary.items():
        for method, figures in methods.items():
            tracked = f"{figures['frames_tracked']['min']:.0f}/{figures['frames']}"
            table.add_row(
                recording,
                names[method],
                tracked,
                _range(figures["ate_m"]),
                _range(figures["ate_online_m"]),
                _centimetres(figures["jitter_rms_m"]["median"]),
                _centimetres(figures["jitter_median_m"]["median"]),
                f"{figures['fps']['median']:.1f}",
                f"{figures['peak_rss_mb']['median']:.0f}",
            )
        table.add_section()
    return table


def _centimetres(metres: float) -> str:
    return f"{CENTIMETRES * metres:.2f}"


def _range(figure: Mapping[str, float]) -> str:
    values = {name: _centimetres(value) for name, value in figure.items()}
    return f"{values['median']} ({values['min']}-{values['max']})"


def plot(
    summary: Mapping[str, Mapping[str, Any]],
    paths: Mapping[str, Mapping[str, Path3d]],
    names: Mapping[str, str],
    target: Path,
) -> None:
    """Above the paths of each recording seen from above, below the errors of all methods."""
    columns = len(paths)
    figure = plt.figure(figsize=(5.5 * columns, 10), layout="constrained")
    grid = figure.add_gridspec(2, columns, height_ratios=[1, 1])
    for column, (recording, methods) in enumerate(paths.items()):
        axis = figure.add_subplot(grid[0, column])
        _draw_paths(axis, methods, names)
        axis.set_title(recording)
        if not column:
            figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    _draw_errors(figure.add_subplot(grid[1, :]), summary, names)
    figure.savefig(target, dpi=110)
    plt.close(figure)


def _draw_paths(axis: Any, methods: Mapping[str, Path3d], names: Mapping[str, str]) -> None:
    first = next(iter(methods.values()))
    # The two axes across the mean direction in which the camera's image points down.
    down = np.abs(first.truth.rotations[:, :, 1].mean(axis=0))
    across, up = (axis for axis in range(3) if axis != int(np.argmax(down)))
    true = first.truth.positions
    axis.plot(true[:, across], true[:, up], color="0.6", linewidth=3.5, label="truth")
    for method, path in methods.items():
        axis.plot(
            path.estimate[:, across],
            path.estimate[:, up],
            color=COLORS[method],
            linewidth=1.2,
            label=names[method],
        )
    margin = 0.15 * np.ptp(true, axis=0).max()
    # A method that is lost may be anywhere; the picture stays with the truth.
    axis.set_xlim(true[:, across].min() - margin, true[:, across].max() + margin)
    axis.set_ylim(true[:, up].min() - margin, true[:, up].max() + margin)
    axis.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal")


def _draw_errors(
    axis: Any, summary: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]
) -> None:
    methods = list(dict.fromkeys(method for each in summary.values() for method in each))
    width = 0.8 / (2 * len(methods))
    for number, method in enumerate(methods):
        shown = [place for place, each in enumerate(summary.values()) if method in each]
        figures = [each[method] for each in summary.values() if method in each]
        for half, (key, label) in enumerate((("ate_m", "refined"), ("ate_online_m", "online"))):
            medians = np.array([CENTIMETRES * each[key]["median"] for each in figures])
            low = medians - [CENTIMETRES * each[key]["min"] for each in figures]
            high = [CENTIMETRES * each[key]["max"] for each in figures] - medians
            shown_cm = np.minimum(medians, HIGHEST_BAR_CM)
            bars = axis.bar(
                np.array(shown) + (2 * number + half - len(methods) + 0.5) * width,
                shown_cm,
                width,
                yerr=np.where(medians > HIGHEST_BAR_CM, 0.0, [low, high]),
                capsize=3,
                color=COLORS[method],
                alpha=1.0 if half == 0 else 0.5,
                label=f"{names[method]}, {label}",
            )
            axis.bar_label(bars, [f"{cm:.2f}" for cm in medians], padding=2, fontsize="small")
    axis.set_xticks(range(len(summary)), list(summary))
    axis.set(ylabel="ATE RMSE [cm]", title="Error: median of the runs, and range")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize="small", ncols=len(methods))
