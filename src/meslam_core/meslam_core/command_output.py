"""What the commands print, and with which status they end."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from meslam_core.pipeline import RunOutcome

BAD_INPUT = 2
TRACKING_LOST = 3
INTERRUPTED = 130


def complain(message: str) -> None:
    """One line on standard error."""
    typer.echo(f"meslam: {printable(message)}", err=True)


def printable(text: str) -> str:
    """A text in one line, without the codes by which names in files could rule a terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def print_entries(entries: Mapping[str, Any], as_json: bool, text: str | None = None) -> None:
    """Results on standard output: as JSON, as the given text, or one line an entry."""
    if as_json:
        typer.echo(json.dumps(entries, indent=2, allow_nan=False))
    elif text is not None:
        typer.echo(text)
    else:
        for name, value in entries.items():
            typer.echo(f"{name:<18} {_readable(value)}")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_readable(item)}" for key, item in value.items()) or "-"
    if isinstance(value, list | tuple):
        return ", ".join(_readable(item) for item in value) or "-"
    return "-" if value is None else printable(str(value))


def run_summary(report: Mapping[str, Any], out: Path) -> str:
    """What a person wants to know of a run's report."""
    lines = [
        f"{report['frames_tracked']} of {report['frames']} frames tracked, "
        f"{report['keyframes']} keyframes, {report['fps']:.1f} frames/s",
        f"map of {report['observed_volume_m3']:.1f} m^3 in {report['regions']} region(s), "
        f"{report['map_bytes'] / 1000:.1f} kB",
    ]
    if "ate_rmse_m" in report:
        lines.append(
            f"ATE {report['ate_rmse_m'] * 100:.2f} cm, online "
            f"{report['ate_online_rmse_m'] * 100:.2f} cm over {report['poses_compared']} poses"
        )
    lines.append(f"results in {out}; look at them with: meslam report {shlex.quote(str(out))}")
    return "\n".join(lines)


def exit_after_run(outcome: RunOutcome, out: Path) -> None:
    """State what went wrong with a run that has results, and exit with the gravest status."""
    frames, tracked = outcome.report["frames"], outcome.report["frames_tracked"]
    status = 0
    if outcome.interrupted:
        complain(f"interrupted after {frames} frames; the results so far are in {out}")
        status = INTERRUPTED
    if outcome.not_evaluated:
        complain(f"no comparison with the truth: {outcome.not_evaluated}")
        status = status or BAD_INPUT
    if outcome.lost:
        complain(
            f"tracking was lost and never recovered; {tracked} of {frames} frames were tracked, "
            f"their results are in {out}. The last frame's reason: {outcome.lost}. If it was the "
            "motion, move the camera more slowly, over surfaces within range"
        )
        status = TRACKING_LOST
    if outcome.broke_off:
        complain(
            f"the recording breaks off: {outcome.broke_off}; the results of the {frames} frames "
            f"before are in {out}"
        )
        status = BAD_INPUT
    if status:
        raise typer.Exit(status)


def exit_if_damaged(path: Path | str, damages: list[str]) -> None:
    """State the damage of a map whose intact part was used."""
    if damages:
        for damage in damages:
            complain(damage)
        complain(f"{path} is damaged; the rest of the map was used. Restore it from a copy.")
        raise typer.Exit(BAD_INPUT)
