"""What faults inject again and again, and what must then hold."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from data.bag_builder import BagBuilder
from faults.bench import Bench, Ended
from faults.fault import Seen
from faults.material import QUICK, Shot, record, shots, truth

Problem = Callable[[Seen], str]
LOST, BAD_INPUT, INTERRUPTED = 3, 2, 130
LONGEST = 300
"""Characters of a message in the table."""


def run(bench: Bench, recording: Path, *options: object, **how: Any) -> Seen:
    """Track and map a recording with the command, and compare it with the truth.

    Args:
        bench: where; `truth.txt` in its folder, else the walk's, is the truth.
        recording: what.
        options: further ones of the command line.
        how: passed to `Bench.meslam`.
    """
    out = bench.folder / "results"
    own = bench.folder / "truth.txt"
    compared = own if own.exists() else truth(bench)
    ended = bench.meslam(
        "run", recording, "--out", out, "--truth", compared, *QUICK, *options, **how
    )
    return seen_of(bench, ended, report=report_in(out))


def report_in(out: Path) -> dict[str, Any]:
    """What a run reported; empty where it did not."""
    try:
        return dict(json.loads((out / "report.json").read_text()))
    except OSError:
        return {}


def seen_of(bench: Bench, *ended: Ended, **facts: Any) -> Seen:
    """What processes and a run's report tell."""
    report = facts.get("report") or {}
    told = []
    if report:
        told.append(f"{report['frames_tracked']} of {report['frames']} frames tracked")
        if report.get("ate_online_rmse_m") is not None:
            told.append(f"{100 * report['ate_online_rmse_m']:.1f} cm off")
    for each in ended:
        if each.status != 0 or not report:
            told.append(f"exit status {each.status}")
        told += [_short(_without_places(line, bench)) for line in each.lines[-2:]]
    return Seen(", ".join(told), {"ended": ended, **facts})


def _without_places(text: str, bench: Bench) -> str:
    """A text that says the same wherever it runs."""
    return text.replace(f"{bench.folder}/", "").replace(f"{bench.cache}/", "")


def _short(line: str) -> str:
    """A message without its last part, where it is long."""
    return line if len(line) <= LONGEST else f"{line[:LONGEST]}..."


def command(*arguments: object) -> Callable[[Bench], Seen]:
    """Run the command with arguments that need nothing."""
    return lambda bench: seen_of(bench, bench.meslam(*arguments))


def walked(change: Callable[[list[Shot]], object], *options: object) -> Callable[[Bench], Seen]:
    """Record the walk after a change of its shots, and run it."""

    def inject(bench: Bench) -> Seen:
        taken = shots()
        changed = change(taken)
        taken = changed if isinstance(changed, list) else taken
        return run(bench, record(taken, bench.folder), *options)

    return inject


def built(build: Callable[[BagBuilder, Shot], None]) -> Callable[[Bench], Seen]:
    """The walk with other messages than a camera's."""

    def inject(bench: Bench) -> Seen:
        builder = BagBuilder()
        for shot in shots():
            build(builder, shot)
        return run(bench, builder.write(bench.folder))

    return inject


def each(change: Callable[[Shot], object], start: int = 0, stop: int | None = None) -> Any:
    """A change of every shot from one number to another."""

    def all_of_them(taken: list[Shot]) -> None:
        for shot in taken[start:stop]:
            change(shot)

    return all_of_them


def tracked(at_least: int, *words: str, within_m: float = 0.02, status: int = 0) -> Problem:
    """So many frames are tracked, none of them far off, and standard error has all words."""

    def problem(seen: Seen) -> str:
        report, (ended,) = seen.facts["report"], seen.facts["ended"]
        if told := _wrong_end(ended, status):
            return told
        if report["frames_tracked"] < at_least:
            return f"{report['frames_tracked']} frames tracked, expected {at_least}"
        off_m = report.get("ate_online_rmse_m")
        if off_m is None:
            return "the trajectory could not be compared with the truth"
        if off_m > within_m:
            return f"{100 * off_m:.1f} cm off, and reported as good"
        return missing(ended.stderr, words)

    return problem


def ended(*words: str, status: int = 0) -> Problem:
    """Every process ends with a status, and standard error has all words."""

    def problem(seen: Seen) -> str:
        for each in seen.facts["ended"]:
            if told := _wrong_end(each, status) or missing(each.stderr, words):
                return told
        return ""

    return problem


def untracked(*words: str) -> Problem:
    """The run ends as lost, without a single pose or a map, and says why."""

    def problem(seen: Seen) -> str:
        if told := ended(*words, status=LOST)(seen):
            return told
        report = seen.facts["report"]
        return "poses of nothing" if report["frames_tracked"] or report["map_bytes"] else ""

    return problem


def broke_off(frames: int, *words: str) -> Problem:
    """The command says where the recording breaks off, and has the results of what came before."""
    return tracked(frames, "breaks off", *words, status=BAD_INPUT)


def refused(*words: str) -> Problem:
    """The command ends with a message that has all words, and leaves no result."""

    def problem(seen: Seen) -> str:
        if told := ended(*words, status=BAD_INPUT)(seen):
            return told
        return "results of a refused input" if seen.facts.get("report") else ""

    return problem


def missing(text: str, words: tuple[str, ...]) -> str:
    """Which words a text lacks; empty where it has all."""
    lacks = [word for word in words if word.lower() not in text.lower()]
    return f"not told: {', '.join(lacks)}" if lacks else ""


def _wrong_end(ended: Ended, status: int) -> str:
    if ended.unexplained:
        return ended.unexplained
    if ended.status != status:
        return f"exit status {ended.status} instead of {status}: {ended.message}"
    return ""
