"""Pictures of an evaluation: paths, errors over time, views beside the camera's images."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from meslam_core.errors import OutputError
from meslam_core.evaluation.trajectory_error import AbsoluteError
from meslam_core.trajectory import NANOSECONDS, Trajectory

TRUTH_COLOR = "0.55"
DEPTH_ERROR_LIMIT_M = 0.10


@dataclass(frozen=True)
class ViewPair:
    """A camera's image and the same view of the reconstruction.

    Attributes:
        label: what to call it, such as its time.
        image: (H, W, 3) uint8 RGB of the camera.
        rendered: (H, W, 3) uint8 RGB of the reconstruction.
        depth_m: (H, W) measured or true depth, 0 where unknown [m].
        rendered_depth_m: (H, W) depth of the reconstruction, 0 where there is none [m].
    """

    label: str
    image: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    rendered_depth_m: NDArray[np.float32]


def plot_path(path: Path, error: AbsoluteError, title: str) -> None:
    """The aligned path from above beside the true one, coloured by its error.

    Raises:
        OutputError: when the picture cannot be written.
    """
    figure, axes = _figure(7.5, 6.0)
    across, up = ground_axes(error.truth)
    truth, estimate = error.truth.positions, error.estimate.positions
    axes.plot(truth[:, across], truth[:, up], color=TRUTH_COLOR, linewidth=3.5, label="truth")
    corners = estimate[:, [across, up]]
    segments = np.stack([corners[:-1], corners[1:]], axis=1)
    line = LineCollection(list(segments), cmap="viridis", linewidths=1.8, label="estimate, aligned")
    line.set_array(100 * error.errors_m[1:])
    axes.add_collection(line)
    axes.plot(*truth[0, [across, up]], "o", color="black", markersize=6, label="start")
    figure.colorbar(line, ax=axes, label="position error [cm]")
    axes.set_title(
        f"{title}: path from above\nATE RMSE {100 * error.rmse_m:.2f} cm over "
        f"{error.truth.length_m:.1f} m"
    )
    axes.set_xlabel(f"{'xyz'[across]} [m]")
    axes.set_ylabel(f"{'xyz'[up]} [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.legend(loc="best")
    _save(figure, path)


def plot_path_alone(path: Path, estimate: Trajectory, title: str) -> None:
    """A path from above where no truth is known.

    Raises:
        OutputError: when the picture cannot be written.
    """
    figure, axes = _figure(7.0, 6.0)
    across, up = ground_axes(estimate)
    positions = estimate.positions
    axes.plot(positions[:, across], positions[:, up], label="estimate")
    axes.plot(*positions[0, [across, up]], "o", color="black", markersize=6, label="start")
    axes.set_title(f"{title}: path from above, {estimate.length_m:.1f} m")
    axes.set_xlabel(f"{'xyz'[across]} [m]")
    axes.set_ylabel(f"{'xyz'[up]} [m]")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best")
    _save(figure, path)


def plot_error_over_time(path: Path, errors: Mapping[str, AbsoluteError], title: str) -> None:
    """Position errors of one or several trajectories over time, by their names.

    Raises:
        OutputError: when the picture cannot be written.
    """
    figure, axes = _figure(8.5, 4.0)
    start = min(int(error.truth.stamps_ns[0]) for error in errors.values())
    for name, error in errors.items():
        time = (error.estimate.stamps_ns - start) / NANOSECONDS
        label = f"{name}: RMSE {100 * error.rmse_m:.2f} cm, max {100 * error.max_m:.2f} cm"
        axes.plot(time, 100 * error.errors_m, linewidth=1.3, label=label)
    axes.set_title(f"{title}: position error after alignment")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("position error [cm]")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    _save(figure, path)


def plot_views(path: Path, pairs: Sequence[ViewPair], title: str) -> None:
    """For each pair a row: the camera's image, the reconstruction, the error of its depth.

    Raises:
        OutputError: when the picture cannot be written.
    """
    figure = Figure(figsize=(13, 3.7 * len(pairs) + 0.5), layout="constrained")
    grid = figure.subplots(len(pairs), 3, squeeze=False)
    figure.suptitle(title)
    for row, pair in zip(grid, pairs, strict=True):
        known = (pair.depth_m > 0) & (pair.rendered_depth_m > 0)
        difference = np.where(known, pair.rendered_depth_m - pair.depth_m, np.nan)
        error_cm = 100 * float(np.nanmedian(np.abs(difference))) if known.any() else float("nan")
        row[0].imshow(pair.image)
        row[0].set_title(f"camera, {pair.label}")
        row[1].imshow(pair.rendered)
        row[1].set_title("reconstruction from the same pose")
        row[2].set_facecolor("0.85")
        limit = 100 * DEPTH_ERROR_LIMIT_M
        shown = row[2].imshow(100 * difference, cmap="RdBu_r", vmin=-limit, vmax=limit)
        row[2].set_title(f"depth error, median {error_cm:.1f} cm (grey: unknown)")
        figure.colorbar(shown, ax=row[2], label="rendered minus camera [cm]", extend="both")
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
    _save(figure, path)


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def ground_axes(trajectory: Trajectory) -> tuple[int, int]:
    """The two axes across the mean direction in which the camera's image points down."""
    down = np.abs(trajectory.rotations[:, :, 1].mean(axis=0))
    across, up = (axis for axis in range(3) if axis != int(np.argmax(down)))
    return across, up


def _save(figure: Figure, path: Path) -> None:
    """Write a picture in one step."""
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.png")
    FigureCanvasAgg(figure)
    try:
        figure.savefig(partial, dpi=110)
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise OutputError(
            f"{path}: the picture cannot be written ({error}); choose a folder that is writable"
        ) from error
