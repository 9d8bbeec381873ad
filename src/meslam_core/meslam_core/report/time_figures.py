"""Figures of what happened when: tracking, losses, times of the stages, the map's growth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from meslam_core.frame_log import FrameTable
from meslam_core.report.figure_style import (
    INK,
    NARROW,
    STAGE_COLORS,
    WIDE,
    drawn,
    run_color,
    run_line,
    thinned,
)
from meslam_core.report.path_figures import run_seconds
from meslam_core.report.run_folder import RunFolder

# From harmless to grave: where one column of the strip stands for several frames, the gravest
# of their states is shown.
STATE_COLORS = {
    "OK": "#56b4e9",
    "INITIALISING": "#bbbbbb",
    "DEGRADED": "#e69f00",
    "RELOCALISING": "#cc79a7",
    "LOST": "#882255",
}
STRIP_COLUMNS = 1000
STACK_COLUMNS = 300
# The first frame trains the map from nothing: so many times what most frames take is shown.
USUAL_SHARE, SHOWN_TIMES = 95.0, 2.0
CURVES = (
    ("residual_m", "residual [mm]", 1e3),
    ("loss_distance", "distance loss", 1.0),
    ("loss_depth", "depth loss", 1.0),
    ("loss_color", "colour loss", 1.0),
)
GROWTH = (
    ("map_bytes", "map [kB]", 1e-3),
    ("regions", "regions", 1.0),
    ("keyframes", "keyframes", 1.0),
    ("rss_mb", "memory [MB]", 1.0),
)

Numbered = Sequence[tuple[int, RunFolder]]


@drawn("Tracking state, position error, residual and training losses over time")
def tracking_figure(runs: Numbered) -> Figure:
    """State, error, residual and losses of runs with recorded frames, over time."""
    curves = [curve for curve in CURVES if any(_frames(run).known(curve[0]) for _, run in runs)]
    compared = [(number, run) for number, run in runs if run.error is not None]
    rows = 1 + bool(compared) + len(curves)
    strip = 0.35 * len(runs) + 0.1
    figure = Figure(figsize=(WIDE, strip + 1.35 * (rows - 1) + 0.6), layout="constrained")
    axes = _stack(figure, rows, [strip, *[1.2] * (rows - 1)])
    _draw_states(axes[0], runs)
    if compared:
        _draw_errors(axes[1], compared)
    for below, (name, label, scale) in zip(axes[1 + bool(compared) :], curves, strict=True):
        _draw_column(below, runs, name, label, scale)
    _finish(figure, axes, runs)
    return figure


def growth_rows(runs: Numbered) -> list[tuple[str, str, float]]:
    """What is known of `GROWTH`."""
    return [row for row in GROWTH if any(_frames(run).known(row[0]) for _, run in runs)]


@drawn("The map's size, regions, keyframes and the memory over time")
def growth_figure(runs: Numbered) -> Figure:
    """What grows during runs that tell any of it."""
    known = growth_rows(runs)
    figure = Figure(figsize=(WIDE, 1.35 * len(known) + 0.6), layout="constrained")
    axes = _stack(figure, len(known), [1.0] * len(known))
    for below, (name, label, scale) in zip(axes, known, strict=True):
        _draw_column(below, runs, name, label, scale)
        if name == "map_bytes":
            _draw_stored(below, runs, scale)
        below.set_ylim(bottom=0)
        below.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    _finish(figure, axes, runs)
    return figure


@drawn("Time of the stages of every frame, stacked, and the time between frames")
def stages_figure(run: RunFolder) -> Figure:
    """The stages' times of every frame, one on the other."""
    table = _frames(run)
    figure = Figure(figsize=(NARROW, 3.2), layout="constrained")
    axes = figure.subplots()
    seconds = run_seconds(run, table.stamps_ns)
    stages = [stage for stage in STAGE_COLORS if table.known(f"{stage}_ms")]
    binned, total = [], np.zeros(len(table))
    for stage in stages:
        values = np.nan_to_num(table.numbers[f"{stage}_ms"])
        total += values
        binned.append(thinned(seconds, values, STACK_COLUMNS)[:2])
    if binned:
        axes.stackplot(
            binned[0][0],
            [values for _, values in binned],
            labels=stages,
            colors=[STAGE_COLORS[stage] for stage in stages],
            lw=0,
        )
    usual = [float(np.percentile(total, USUAL_SHARE))]
    highest = [float(total.max())]
    for name, label, style in (
        ("frame_ms", "from frame to frame", "-"),
        ("latency_ms", "latency", ":"),
    ):
        if table.known(name):
            x, middle, _, _ = thinned(seconds, table.numbers[name], STACK_COLUMNS)
            axes.plot(x, middle, color=INK, linewidth=0.9, linestyle=style, label=label)
            usual.append(float(np.nanpercentile(table.numbers[name], USUAL_SHARE)))
            highest.append(float(np.nanmax(table.numbers[name])))
    shown_ms = min(1.05 * max(highest), SHOWN_TIMES * max(usual))
    axes.set_ylim(0, 1.2 * max(shown_ms, 1.0))
    axes.margins(x=0.01)
    axes.set(xlabel="time [s]", ylabel="time of a frame [ms]")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", ncols=3)
    return figure


def _frames(run: RunFolder) -> FrameTable:
    assert run.frames is not None, "only runs with recorded frames are drawn over time"
    return run.frames


def _stack(figure: Figure, rows: int, heights: list[float]) -> list[Axes]:
    """Axes below each other over one time."""
    grid = figure.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=heights)
    return list(grid[:, 0])


def _finish(figure: Figure, axes: list[Axes], runs: Numbered) -> None:
    axes[-1].set_xlabel("time [s]")
    for each in axes:
        each.margins(x=0.0)
    figure.align_ylabels()
    if len(runs) > 1:
        handles = [
            axes[-1].plot([], [], color=run_color(n), linestyle=run_line(n), label=run.name)[0]
            for n, run in runs
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=4)


def _draw_column(axes: Axes, runs: Numbered, name: str, label: str, scale: float) -> None:
    for number, run in runs:
        table = _frames(run)
        seconds = run_seconds(run, table.stamps_ns)
        _draw_curve(axes, number, seconds, scale * table.numbers[name])
    axes.set_ylabel(label)


def _draw_stored(axes: Axes, runs: Numbered, scale: float) -> None:
    """A dot at the end for the map as it was stored after the last refinement."""
    for number, run in runs:
        stored = run.entries.get("map_bytes")
        if isinstance(stored, int):
            seconds = run_seconds(run, _frames(run).stamps_ns)
            axes.plot(
                seconds[-1],
                scale * stored,
                "o",
                color=run_color(number),
                clip_on=False,
                markersize=5,
            )


def _draw_errors(axes: Axes, runs: Numbered) -> None:
    for number, run in runs:
        assert run.error is not None
        seconds = run_seconds(run, run.error.estimate.stamps_ns)
        _draw_curve(axes, number, seconds, 100.0 * run.error.errors_m)
    axes.set_ylabel("error [cm]")
    axes.set_ylim(bottom=0)


def _draw_curve(
    axes: Axes, number: int, seconds: NDArray[np.floating], values: NDArray[np.floating]
) -> None:
    x, middle, low, high = thinned(seconds, values)
    color = run_color(number)
    axes.fill_between(x, low, high, color=color, alpha=0.2, lw=0)
    axes.plot(x, middle, color=color, linestyle=run_line(number), linewidth=1.1)


def _draw_states(axes: Axes, runs: Numbered) -> None:
    """A strip a run, coloured by the state."""
    severity = {name: rank for rank, name in enumerate(STATE_COLORS)}
    colors = np.array([to_rgba(color) for color in STATE_COLORS.values()])
    for row, (_, run) in enumerate(runs):
        table = _frames(run)
        seconds = run_seconds(run, table.stamps_ns)
        end = max(float(seconds.max()), 1e-3)
        ranks = np.array([severity[state] for state in table.states])
        column = np.minimum((seconds / end * STRIP_COLUMNS).astype(int), STRIP_COLUMNS - 1)
        gravest = np.full(STRIP_COLUMNS, -1)
        np.maximum.at(gravest, np.maximum(column, 0), ranks)
        # A state lasts until the next frame.
        last = np.maximum.accumulate(np.where(gravest >= 0, np.arange(STRIP_COLUMNS), 0))
        shown = colors[np.maximum(gravest[last], 0)]
        axes.imshow(
            shown[None],
            extent=(0.0, end, row + 0.42, row - 0.42),
            aspect="auto",
            interpolation="nearest",
        )
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_yticks(range(len(runs)), [run.name for _, run in runs] if len(runs) > 1 else ["state"])
    axes.grid(visible=False)
    axes.tick_params(axis="y", length=0)
    for side in axes.spines.values():
        side.set_visible(False)
