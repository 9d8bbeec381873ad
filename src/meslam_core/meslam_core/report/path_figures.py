"""Figures of where the camera was: the path against the truth, and the error along it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from meslam_core.evaluation.plots import ground_axes
from meslam_core.evaluation.trajectory_error import AbsoluteError
from meslam_core.map.neural_map import NeuralMap
from meslam_core.report.figure_style import (
    INK,
    MOST_POINTS,
    NARROW,
    TRUTH_COLOR,
    WIDE,
    drawn,
    run_color,
    run_line,
    thinned,
)
from meslam_core.report.run_folder import RunFolder
from meslam_core.trajectory import NANOSECONDS, Trajectory

MOST_BOXES = 300
ERROR_COLORS = "viridis"
# The least width of a view from above: on a shorter path it would show nothing but noise [m].
LEAST_WIDTH_M = 0.2

Floats = NDArray[np.floating]


@drawn("The path from above, coloured by its error, and its height over time")
def path_figure(run: RunFolder, number: int) -> Figure:
    """The path of a run that has one: from above, and its height."""
    assert run.refined is not None
    figure = Figure(figsize=(NARROW, 6.6), layout="constrained")
    above, height = figure.subplots(2, 1, height_ratios=(3.4, 1.0))
    estimate = run.refined if run.error is None else run.error.estimate
    truth = None if run.error is None else run.error.truth
    across, up = ground_axes(estimate if truth is None else truth)
    if truth is not None:
        _draw_above(above, truth, across, up, color=TRUTH_COLOR, linewidth=4.0, label="truth")
    if run.error is None:
        _draw_above(above, estimate, across, up, color=run_color(number), label="estimate")
    else:
        _draw_error(figure, above, run.error, across, up)
    start = estimate.positions[0]
    above.plot(start[across], start[up], "o", color=INK, markersize=6, label="start")
    _frame_path(above, estimate if truth is None else truth, across, up)
    if run.map is not None:
        T_shown_map = np.eye(4) if run.error is None else run.error.mounting.T_truth_map
        _draw_boxes(above, run.map, T_shown_map, across, up)
    above.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]")
    above.legend(loc="best")
    vertical = 3 - across - up
    # Images point down: what their y axis agrees with is depth, not height.
    sign = -float(np.sign(estimate.rotations[:, vertical, 1].mean()) or 1.0)
    if truth is not None:
        _draw_height(height, run, truth, vertical, sign, TRUTH_COLOR, 4.0)
    _draw_height(height, run, estimate, vertical, sign, run_color(number), 1.3)
    height.set(xlabel="time [s]", ylabel="height [m]")
    return figure


@drawn("Position error over the length of the path")
def error_figure(runs: Sequence[tuple[int, RunFolder]]) -> Figure:
    """Position errors of runs with a truth, by their numbers in the report."""
    size = (NARROW, 4.0) if len(runs) == 1 else (WIDE, 3.4)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    for number, run in runs:
        for error, name, alpha in ((run.error, "refined", 1.0), (run.online_error, "online", 0.6)):
            assert error is not None
            walked = np.linalg.norm(np.diff(error.truth.positions, axis=0), axis=1).cumsum()
            x, middle, _, high = thinned(np.append(0.0, walked), 100.0 * error.errors_m)
            label = f"{run.name}, {name}: RMSE {100 * error.rmse_m:.2f} cm"
            axes.plot(
                x,
                middle,
                color=run_color(number),
                linestyle=run_line(number),
                alpha=alpha,
                label=label,
            )
            axes.fill_between(x, middle, high, color=run_color(number), alpha=0.2 * alpha, lw=0)
    axes.set(xlabel="length of the true path [m]", ylabel="position error [cm]")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    axes.legend(loc="upper left", ncols=min(len(runs), 3))
    return figure


def run_seconds(run: RunFolder, stamps_ns: NDArray[np.int64]) -> Floats:
    """Seconds since the run's first frame."""
    seconds: Floats = (stamps_ns - run.first_stamp_ns) / NANOSECONDS
    return seconds


def _draw_above(axes: Axes, path: Trajectory, across: int, up: int, **style: Any) -> None:
    shown = path.positions[_spread(len(path))]
    axes.plot(shown[:, across], shown[:, up], **style)


def _draw_error(figure: Figure, axes: Axes, error: AbsoluteError, across: int, up: int) -> None:
    kept = _spread(len(error.estimate))
    corners = error.estimate.positions[kept][:, [across, up]]
    segments = np.stack([corners[:-1], corners[1:]], axis=1)
    line = LineCollection(list(segments), cmap=ERROR_COLORS, linewidths=1.8)
    line.set_array(100.0 * error.errors_m[kept][1:])
    axes.add_collection(line)
    middle = colormaps[ERROR_COLORS](0.5)
    axes.plot([], [], color=middle, linewidth=1.8, label="estimate, aligned")
    bar = figure.colorbar(line, ax=axes, label="position error [cm]", shrink=0.8, aspect=30)
    bar.outline.set_visible(False)


def _draw_height(
    axes: Axes,
    run: RunFolder,
    path: Trajectory,
    vertical: int,
    sign: float,
    color: str,
    linewidth: float,
) -> None:
    kept = _spread(len(path))
    height_m = sign * path.positions[kept, vertical]
    axes.plot(run_seconds(run, path.stamps_ns[kept]), height_m, color=color, linewidth=linewidth)


def _draw_boxes(
    axes: Axes, neural_map: NeuralMap, T_shown_map: Floats, across: int, up: int
) -> None:
    """Outlines of the regions from above."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    outlines = []
    for region in neural_map.regions[:MOST_BOXES]:
        corners = np.zeros((4, 4))
        corners[:, :2], corners[:, 3] = square * region.stored.half_side_m, 1.0
        shown = corners @ (T_shown_map @ region.stored.T_map_region).T
        outline = shown[:, [across, up]]
        if _is_seen(axes, outline):
            outlines.append(outline)
    if outlines:
        boxes = PolyCollection(
            outlines, facecolors="none", edgecolors=INK, linestyles="--", linewidths=0.7
        )
        boxes.set_label("regions' boxes")
        axes.add_collection(boxes, autolim=False)


def _is_seen(axes: Axes, outline: Floats) -> bool:
    """Whether the edge of a box (N, 2) passes through what the axes show."""
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    box_low, box_high = outline.min(axis=0), outline.max(axis=0)
    around = (box_low <= low).all() and (high <= box_high).all()
    return bool((box_low < high).all() and (low < box_high).all() and not around)


def _frame_path(axes: Axes, path: Trajectory, across: int, up: int) -> None:
    """Show the path with a margin, however far the boxes reach."""
    center = path.positions[:, [across, up]].mean(axis=0)
    axes.update_datalim(center + 0.5 * LEAST_WIDTH_M * np.array([[-1.0, -1.0], [1.0, 1.0]]))
    axes.margins(0.1)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()


def _spread(count: int) -> NDArray[np.intp]:
    """At most `MOST_POINTS` numbers below a count, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.intp))
