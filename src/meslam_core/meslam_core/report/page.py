"""The page: one file without references to anything outside of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

import meslam_core
from meslam_core.errors import EvaluationError
from meslam_core.map.files import cannot_write, write_atomically
from meslam_core.report import map_views
from meslam_core.report.configuration import setting_lines
from meslam_core.report.figure_style import run_color
from meslam_core.report.map_views import MapView
from meslam_core.report.origin import origin_lines
from meslam_core.report.path_figures import error_figure, path_figure
from meslam_core.report.result_table import ABSENT, TILES, number, result_groups
from meslam_core.report.run_folder import RunFolder
from meslam_core.report.time_figures import (
    STATE_COLORS,
    growth_figure,
    growth_rows,
    stages_figure,
    tracking_figure,
)

TEMPLATE = "page.html.j2"
VIEWS, MOST_VIEWS, LEAST_VIEWS = 5, 20, 2
STAGES = ("reading", "odometry", "tracking", "mapping", "latency")
MOST_TROUBLES = 8


@dataclass
class RunPart:
    """What the page shows of one run alone.

    Attributes:
        run: its results.
        color: that it has in figures.
        path: figure of its path; None without one.
        stages: figure of its stages' times; None where they were not recorded.
        stage_rows: name, median and 95th percentile [ms] of each stage.
        views: of its map.
        troubles: states other than OK with their reasons, and how often they came.
    """

    run: RunFolder
    color: str
    path: Markup | None
    stages: Markup | None
    stage_rows: list[tuple[str, float, float]]
    views: list[MapView]
    troubles: list[tuple[str, str, int, float]]


def write_report(
    runs: Sequence[RunFolder],
    path: Path,
    views: int = VIEWS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the report about runs as one HTML file.

    Args:
        runs: to show side by side.
        path: of the file; an existing one is replaced in one step.
        views: how many poses of each run to show the map from; fewer where there are many runs.
        progress: is told how many of the views are done.

    Raises:
        EvaluationError: without runs.
        OutputError: when the file cannot be written.
    """
    if not runs:
        raise EvaluationError("there is no run to report on; name the folders of runs")
    _name_apart(runs)
    parts = _parts(runs, views, progress)
    numbered = list(enumerate(runs))
    recorded = [(n, run) for n, run in numbered if run.frames is not None]
    compared = [(n, run) for n, run in numbered if run.error is not None]
    content = _template().render(
        title=" · ".join(run.name for run in runs),
        parts=parts,
        groups=result_groups(runs),
        error=error_figure(compared) if compared else None,
        tracking=tracking_figure(recorded) if recorded else None,
        growth=growth_figure(recorded) if growth_rows(recorded) else None,
        state_colors=STATE_COLORS,
        depth_limit_cm=100 * map_views.LIMIT_M,
        depth_colors=Markup(map_views.color_bar()),
        sections=setting_lines(runs),
        origin=origin_lines(runs),
        tiles=TILES,
        absent=ABSENT,
        version=meslam_core.__version__,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )
    try:
        write_atomically(path, content.encode())
    except OSError as error:
        raise cannot_write(path, error) from error


def _parts(
    runs: Sequence[RunFolder], views: int, progress: Callable[[int, int], None]
) -> list[RunPart]:
    shown = [run for run in runs if run.map is not None and run.refined is not None]
    count = min(views, max(LEAST_VIEWS, MOST_VIEWS // max(len(shown), 1)))
    stamps = map_views.chosen_stamps(shown, count)
    total, done = sum(map(len, stamps)), 0

    def one_more() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    seen = {
        id(run): map_views.map_views(run, chosen, one_more)
        for run, chosen in zip(shown, stamps, strict=True)
    }
    return [
        RunPart(
            run=run,
            color=run_color(n),
            path=path_figure(run, n) if run.refined is not None else None,
            stages=stages_figure(run) if run.frames is not None else None,
            stage_rows=list(_stage_rows(run.entries)),
            views=seen.get(id(run), []),
            troubles=_troubles(run),
        )
        for n, run in enumerate(runs)
    ]


def _stage_rows(entries: Mapping[str, Any]) -> Iterator[tuple[str, float, float]]:
    for stage in STAGES:
        median, p95 = (number(entries, "stage_ms", stage, key) for key in ("median", "p95"))
        if median is not None and p95 is not None:
            yield stage, median, p95


def _troubles(run: RunFolder) -> list[tuple[str, str, int, float]]:
    """What was not OK: state, reason, number of frames, first time [s]; the most frequent first."""
    if run.frames is None:
        return []
    found: dict[tuple[str, str], list[int]] = {}
    table = run.frames
    for index, (state, reason) in enumerate(zip(table.states, table.reasons, strict=True)):
        if state != "OK":
            found.setdefault((state, reason), []).append(index)
    ordered = sorted(found.items(), key=lambda item: -len(item[1]))
    start = run.first_stamp_ns
    return [
        (state, reason, len(at), (int(table.stamps_ns[at[0]]) - start) * 1e-9)
        for (state, reason), at in ordered[:MOST_TROUBLES]
    ]


def _name_apart(runs: Sequence[RunFolder]) -> None:
    """Tell folders of the same name apart by the ones they lie in."""
    names = [run.name for run in runs]
    for run in runs:
        if names.count(run.name) > 1:
            run.name = "/".join(run.path.resolve().parts[-2:])


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("meslam_core.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE)
