"""The `meslam` command's look at the machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meslam_core.command_output import print_entries

if TYPE_CHECKING:
    from collections.abc import Sequence

    from meslam_core.doctor.diagnosis import Area

app = typer.Typer()

UNHEALTHY = 1


@app.command()
def doctor(
    out: Annotated[Path, typer.Option(help="Folder that results are to go to.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")] = False,
) -> None:
    """Check this computer, and say what is wrong and how to mend it.

    Exit status 1 when something would keep MeSLAM from working.
    """
    from meslam_core.console import error_console
    from meslam_core.doctor import Status
    from meslam_core.doctor.diagnosis import diagnose, examinations, gravest

    with error_console().status("starting") as shown:
        areas = list(diagnose(examinations(out), lambda area: shown.update(f"checking {area}")))
    worst = gravest(areas)
    if as_json:
        found = {area.name: [finding.to_dict() for finding in area.findings] for area in areas}
        print_entries({"status": str(worst), "areas": found}, as_json)
    else:
        _print_table(areas)
    if worst is Status.FAIL:
        raise typer.Exit(UNHEALTHY)


def _print_table(areas: Sequence[Area]) -> None:
    """Every finding as a line, and below it what to do."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styles = {"ok": "green", "warn": "yellow", "fail": "bold red"}
    table = Table(box=None, pad_edge=False)
    for column in ("area", "", "what", "finding"):
        table.add_column(column, no_wrap=column != "finding")
    for area in areas:
        for number, finding in enumerate(area.findings):
            told = Text(finding.told)
            if finding.remedy:
                told.append(f"\n-> {finding.remedy}", "bold")
            name = "" if number else area.name
            status = Text(finding.status, styles[finding.status])
            table.add_row(name, status, finding.subject, told)
    Console(highlight=False).print(table)
