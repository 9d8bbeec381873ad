"""Table, verdicts and plot of the benchmark of map sizes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from machine import machine_line
from rich.console import Console
from rich.table import Table

mpl.use("Agg")
from matplotlib import pyplot as plt

MAX_DEPTH_M = 4.0
MEGABYTE = 1e6
STORED = "ours, int8"
EXACT = "ours, fp32"
# What is wanted of the stored map.
MOST_BYTES = 0.2 * MEGABYTE
MOST_GROWTH = 0.02
LEAST_COMPLETION = 0.90
MOST_ACCURACY_M = 0.015
MOST_LOSS = 0.02


@dataclass(frozen=True)
class Row:
    """One map.

    Attributes:
        method: and precision or voxel size.
        seconds: of the recording.
        bytes: of the map as it is kept.
        packed_bytes: losslessly compressed.
        error: fields of `SurfaceError` [m] and the completion ratio.
        ate_m: of the poses that it was made with; 0 for true ones [m].
        regions: of ours.
    """

    method: str
    seconds: float
    bytes: int
    packed_bytes: int
    error: dict[str, float]
    ate_m: float = 0.0
    regions: int = 0


def table_of(rows: Sequence[Row]) -> Table:
    """One row a method and duration."""
    table = Table(title="The same 57 m³ seen for longer and longer")
    table.add_column("map")
    for column in (
        "seen [s]",
        "size [MB]",
        "compressed [MB]",
        "accuracy, median [cm]",
        "mean [cm]",
        "completion, median [cm]",
        "within 5 cm [%]",
        "ATE [cm]",
        "regions",
    ):
        table.add_column(column, justify="right")
    for method in dict.fromkeys(each.method for each in rows):
        for each in sorted(chosen(rows, method), key=lambda row: row.seconds):
            table.add_row(
                method,
                f"{each.seconds:g}",
                _megabytes(each.bytes),
                _megabytes(each.packed_bytes),
                _centimetres(each.error["accuracy_median_m"]),
                _centimetres(each.error["accuracy_mean_m"]),
                _centimetres(each.error["completion_median_m"]),
                f"{100 * each.error['completion_ratio']:.1f}",
                _centimetres(each.ate_m) if each.regions else "true poses",
                str(each.regions) if each.regions else "",
            )
        table.add_section()
    return table


def chosen(rows: Sequence[Row], method: str) -> list[Row]:
    """The rows of a method."""
    return [each for each in rows if each.method == method]


def _megabytes(count: int) -> str:
    return f"{count / MEGABYTE:.3f}" if count < MEGABYTE else f"{count / MEGABYTE:.1f}"


def _centimetres(metres: float) -> str:
    return f"{100 * metres:.2f}"


def verdicts(rows: Sequence[Row]) -> list[str]:
    """Whether the stored map is as small and as good as it should be, worst duration first."""
    stored, exact = chosen(rows, STORED), chosen(rows, EXACT)
    if not stored or len(stored) != len(exact):
        return []
    sizes = [each.bytes for each in stored]
    growth = max(sizes) / min(sizes) - 1.0
    ratio = min(each.error["completion_ratio"] for each in stored)
    accuracy_m = max(each.error["accuracy_median_m"] for each in stored)
    pairs = list(zip(stored, exact, strict=True))
    loss = max(_loss(a.error, b.error) for a, b in pairs)
    lines = [
        _verdict(f"largest stored map: {_megabytes(max(sizes))} MB", max(sizes) <= MOST_BYTES)
        + f" of {_megabytes(int(MOST_BYTES))} MB",
        _verdict(f"least within 5 cm: {100 * ratio:.1f} %", ratio >= LEAST_COMPLETION)
        + f" of {100 * LEAST_COMPLETION:g} %",
        _verdict(
            f"largest median accuracy: {_centimetres(accuracy_m)} cm",
            accuracy_m <= MOST_ACCURACY_M,
        )
        + f" of {_centimetres(MOST_ACCURACY_M)} cm",
        _verdict(f"int8 is at most {100 * loss:.1f} % worse than fp32", loss <= MOST_LOSS)
        + f" of {100 * MOST_LOSS:g} %",
    ]
    if len(sizes) > 1:
        lines.append(
            _verdict(f"sizes differ by {100 * growth:.1f} %", growth <= MOST_GROWTH)
            + f" of {100 * MOST_GROWTH:g} %"
        )
    return lines


def _loss(stored: dict[str, float], exact: dict[str, float]) -> float:
    """The largest relative loss of accuracy, completion or the completed share; 0 for none."""
    worse = [stored[name] / exact[name] - 1.0 for name in stored if name.endswith("_m")]
    return max(0.0, *worse, 1.0 - stored["completion_ratio"] / exact["completion_ratio"])


def _verdict(said: str, holds: bool) -> str:
    return f"{said}: {'within' if holds else 'MISSES'} the target"


def plot(rows: Sequence[Row], path: Path) -> None:
    """Bytes, accuracy and completion by duration, a line a method."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    for number, method in enumerate(dict.fromkeys(each.method for each in rows)):
        line = sorted(chosen(rows, method), key=lambda row: row.seconds)
        seconds = [each.seconds for each in line]
        style = {"label": method, "marker": "o", "color": f"C{number}"}
        style["linestyle"] = "-" if line[0].regions else "--"
        axes[0].plot(seconds, [each.bytes / MEGABYTE for each in line], **style)
        accuracy = [100 * each.error["accuracy_median_m"] for each in line]
        axes[1].plot(seconds, accuracy, **style)
        completion = [100 * each.error["completion_ratio"] for each in line]
        axes[2].plot(seconds, completion, **style)
    axes[0].set(yscale="log", ylabel="size of the map [MB]")
    axes[1].set(ylabel="accuracy, median [cm]", ylim=(0, None))
    axes[2].set(ylabel="observed surface within 5 cm [%]")
    for axis in axes:
        axis.set(xlabel="time that the space was seen [s]")
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write_results(rows: Sequence[Row], head: dict[str, Any], stem: Path, console: Console) -> None:
    """STEM.txt, STEM.json and STEM.png, and the table on the console.

    Args:
        rows: of all maps.
        head: what the JSON begins with; its command, machine and note stand above the table.
        stem: path of the files without their ending.
        console: to show the table on.
    """
    console.print(table_of(rows))
    for line in verdicts(rows):
        console.print(line)
    with stem.with_suffix(".txt").open("w") as file:
        file.write(f"Made by `{head['command']}`\n\n{machine_line(head['machine'])}\n")
        file.write(f"{head['note']}\n")
        Console(file=file, width=160, markup=False).print(table_of(rows))
        file.write("\n" + "\n".join(verdicts(rows)) + "\n")
    result = {**head, "rows": [asdict(each) for each in rows]}
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    plot(rows, stem.with_suffix(".png"))
