"""`python -m faults`: inject all faults and write the table."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from faults import table
from faults.catalogue import every_fault
from faults.fault import Fault
from faults.injection import RESULT, Result, Verdict
from faults.runner import POLL_S, Trial
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("src/**/*.py", "src/**/*.cpp", "test/faults/*.py", "test/data/*.py")


def main(
    names: Annotated[
        list[str] | None, typer.Argument(help="Faults or groups; all by default.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Where they work, and what they left.")] = (
        ROOT / "out" / "faults"
    ),
    page: Annotated[Path | None, typer.Option(help="Where the table goes.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Faults at a time.")] = 2,
    fresh: Annotated[bool, typer.Option(help="Forget earlier results.")] = False,
    outdated: Annotated[
        bool, typer.Option(help="Take results that other sources gave, too: while developing.")
    ] = False,
) -> None:
    """Inject faults and write the table; exit status 1 when one of them was missed.

    A run that was interrupted goes on where it was: results stay valid as long as no source
    changes.
    """
    chosen = [
        fault for fault in every_fault() if not names or fault.name in names or fault.group in names
    ]
    if not chosen:
        raise typer.BadParameter(f"no fault and no group is called {' or '.join(names or [])}")
    folder = out / _fingerprint()
    earlier = sorted(out.glob("*/"), key=lambda path: path.stat().st_mtime) if outdated else []
    known: dict[str, Result] = {}
    for each in [] if fresh else [*earlier, folder]:
        known |= _known(chosen, each)
    results = dict(known)
    begun = time.monotonic()
    # Whoever needs the machine for itself comes last.
    waiting = sorted((f for f in chosen if f.name not in known), key=lambda fault: fault.alone)
    console = Console(stderr=True, highlight=False)
    with _bar(console) as bar:
        task = bar.add_task("", total=len(chosen), completed=len(known))
        for result in _trials(waiting, folder, folder / "cache", jobs):
            results[result.name] = result
            bar.update(task, advance=1, description=result.name)
            if result.verdict != Verdict.AS_EXPECTED:
                console.print(f"{result.name}: {result.verdict}: {result.problem or result.seen}")
    wall_s = None if known else time.monotonic() - begun
    page = page or (out / "reliability.md" if names else ROOT / "docs" / "reliability.md")
    table.write(page, chosen, results, wall_s)
    console.print(table.summary(list(results.values()), wall_s), f"The table is in {page}.")
    if any(result.verdict == Verdict.MISSED for result in results.values()):
        raise typer.Exit(1)


def _trials(faults: list[Fault], folder: Path, cache: Path, jobs: int) -> Iterator[Result]:
    """The results as they come, some faults at a time."""
    waiting, running = list(faults), list[Trial]()
    try:
        while waiting or running:
            while waiting and _may_start(waiting[0], running, jobs):
                fault = waiting.pop(0)
                running.append(Trial(fault, folder / fault.name, cache))
            for trial in list(running):
                if (result := trial.poll()) is not None:
                    running.remove(trial)
                    yield result
            time.sleep(POLL_S)
    finally:
        for trial in running:
            trial.stop()


def _may_start(fault: Fault, running: list[Trial], jobs: int) -> bool:
    if fault.alone or any(trial.fault.alone for trial in running):
        return not running
    return len(running) < jobs


def _known(faults: list[Fault], folder: Path) -> dict[str, Result]:
    """What an interrupted run found out, but for what it missed."""
    files = [folder / fault.name / RESULT for fault in faults]
    results = [Result.read(file) for file in files if file.exists()]
    return {result.name: result for result in results if result.verdict != Verdict.MISSED}


def _fingerprint() -> str:
    """Of all sources that results depend on."""
    digest = hashlib.sha256()
    for pattern in SOURCES:
        for file in sorted(ROOT.glob(pattern)):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def _bar(console: Console) -> Progress:
    return Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
    )


if __name__ == "__main__":
    typer.run(main)
