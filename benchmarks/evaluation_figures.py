"""Picture of the evaluation: errors, speed and map sizes, by recording and method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from trajectory_figures import CENTIMETRES, HIGHEST_BAR_CM, spread

mpl.use("Agg")
from matplotlib import pyplot as plt

COLORS = {
    "meslam": "tab:blue",
    "fine": "cornflowerblue",
    "paper": "tab:cyan",
    "imap_star": "tab:red",
    "tsdf": "tab:orange",
    "pose_graph": "tab:green",
}
# Figure, its label, factor, whether the scale is logarithmic, and where bars end.
PANELS: tuple[tuple[str, str, float, bool, float], ...] = (
    ("ate_m", f"ATE, refined [cm], to {HIGHEST_BAR_CM:g}", CENTIMETRES, False, HIGHEST_BAR_CM),
    ("fps", "frames a second", 1.0, False, np.inf),
    ("peak_rss_mb", "peak memory [MB]", 1.0, False, np.inf),
    ("map_bytes", "map [kB]", 1e-3, True, np.inf),
)


def plot(
    rows: Mapping[tuple[str, str], Sequence[Mapping[str, Any]]],
    names: Mapping[str, str],
    target: Path,
) -> None:
    """Medians of the seeds as bars, with their ranges; one panel a figure."""
    recordings = list(dict.fromkeys(recording for recording, _ in rows))
    methods = [method for method in names if any(method == each for _, each in rows)]
    size = (max(7.0, 1.7 * len(recordings)), 2.6 * len(PANELS))
    figure, axes = plt.subplots(len(PANELS), figsize=size, sharex=True, layout="constrained")
    width = 0.8 / max(len(methods), 1)
    for axis, (name, label, factor, logarithmic, highest) in zip(axes, PANELS, strict=True):
        for number, method in enumerate(methods):
            shown = [place for place, each in enumerate(recordings) if (each, method) in rows]
            seeds = [rows[recordings[place], method] for place in shown]
            figures = [spread(each, name) for each in seeds]
            medians = factor * np.array([each["median"] for each in figures])
            low = medians - factor * np.array([each["min"] for each in figures])
            high = factor * np.array([each["max"] for each in figures]) - medians
            cut = medians > highest
            axis.bar(
                np.array(shown) + (number - (len(methods) - 1) / 2) * width,
                np.minimum(medians, highest),
                width,
                yerr=np.where(cut, 0.0, [low, high]),
                capsize=2,
                color=COLORS[method],
                label=names[method].replace("`", "").replace("\\", ""),
            )
        axis.set_yscale("log" if logarithmic else "linear")
        axis.set_ylabel(label, fontsize="small")
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xticks(range(len(recordings)), recordings, fontsize="small")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(target, dpi=90)
    plt.close(figure)
