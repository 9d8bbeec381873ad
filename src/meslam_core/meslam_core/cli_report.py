"""The `meslam` command's report about runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meslam_core.errors import EvaluationError

if TYPE_CHECKING:
    from meslam_core.report import RunFolder

PAGE = "report.html"

app = typer.Typer()


@app.command()
def report(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Folders that `meslam run` wrote.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.html",
            help="The page; by default report.html in the run's folder, or here for several runs.",
        ),
    ] = None,
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="POSES.txt",
            help="True poses (TUM format) instead of those that the runs name; repeatable, one "
            "for all runs or one for each.",
        ),
    ] = None,
    recording: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings that were moved; repeatable, one for all runs or for each."),
    ] = None,
    lever_arm: Annotated[
        bool,
        typer.Option("--lever-arm", help="The true poses are another sensor's on the same mount."),
    ] = False,
    views: Annotated[
        int, typer.Option(min=0, max=20, help="Poses of each run to show the map from.")
    ] = 5,
) -> None:
    """Make a page about one run, or about several side by side.

    One HTML file that needs nothing else: the path against the truth, the map beside the camera's
    images, tracking, losses, times and the map's size over time, the configuration.
    """
    truths = _one_each("--truth", truth, len(runs))
    recordings = _one_each("--recording", recording, len(runs))
    from meslam_core.console import counting_bar, error_console, waiting
    from meslam_core.report import read_run, write_report

    target = out or (runs[0] / PAGE if len(runs) == 1 else Path(PAGE))
    read: list[RunFolder] = []
    try:
        with waiting("reading what the runs left"):
            for run, poses, source in zip(runs, truths, recordings, strict=True):
                read.append(read_run(run, poses, source, lever_arm))
        with counting_bar(error_console(), "views") as progress:
            write_report(read, target, views, progress)
    finally:
        for each in read:
            each.close()
    for each in read:
        for sentence in each.missing:
            typer.echo(f"meslam: {each.name}: {sentence}", err=True)
    typer.echo(f"report in {target}")


def _one_each(option: str, given: list[Path] | None, count: int) -> list[Path | None]:
    """What an option gives for each run."""
    if not given:
        return [None] * count
    if len(given) == 1:
        return [*given] * count
    if len(given) != count:
        raise EvaluationError(
            f"{option} was given {len(given)} times for {count} runs; give it once for all, or "
            "once for each in their order"
        )
    return [*given]
