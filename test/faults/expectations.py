"""What faults inject again and again, and what must then hold."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults.bench import Bench, Ended
from faults.fault import Seen
from faults.material import QUICK, Shot, record, shots, truth

Problem = Callable[[Seen], str]


def run(bench: Bench, recording: Path, *options: object) -> Seen:
    """Track and map a recording with the command, and compare it with the walk's truth."""
    out = bench.folder / "results"
    ended = bench.meslam("run", recording, "--out", out, "--truth", truth(bench), *QUICK, *options)
    report: dict[str, Any] = {}
    if (out / "report.json").exists():
        report = json.loads((out / "report.json").read_text())
    return seen_of(bench, ended, report=report)


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
        told += [line.removeprefix("meslam: ") for line in each.stderr.splitlines()
                 if line.startswith("meslam: ")][-2:]  # fmt: skip
    words = ", ".join(told).replace(f"{bench.folder}/", "").replace(f"{bench.cache}/", "")
    return Seen(words, {"ended": ended, **facts})


def walked(change: Callable[[list[Shot]], object], *options: object) -> Callable[[Bench], Seen]:
    """Record the walk after a change of its shots, and run it."""

    def inject(bench: Bench) -> Seen:
        taken = shots()
        changed = change(taken)
        taken = changed if isinstance(changed, list) else taken
        return run(bench, record(taken, bench.folder), *options)

    return inject


def each(change: Callable[[Shot], object]) -> Callable[[list[Shot]], None]:
    """A change of every shot."""

    def all_of_them(taken: list[Shot]) -> None:
        for shot in taken:
            change(shot)

    return all_of_them


def tracked(at_least: int, *words: str, within_m: float = 0.02, status: int = 0) -> Problem:
    """So many frames are tracked, none of them far off, and standard error has all words."""

    def problem(seen: Seen) -> str:
        report, (ended,) = seen.facts["report"], seen.facts["ended"]
        if ended.unexplained:
            return ended.unexplained
        if ended.status != status:
            return f"exit status {ended.status} instead of {status}: {ended.message}"
        if report["frames_tracked"] < at_least:
            return f"{report['frames_tracked']} frames tracked, expected {at_least}"
        off_m = report.get("ate_online_rmse_m")
        if off_m is None:
            return "the trajectory could not be compared with the truth"
        if off_m > within_m:
            return f"{100 * off_m:.1f} cm off, and reported as good"
        return missing(ended.stderr, words)

    return problem


def refused(*words: str, status: int = 2) -> Problem:
    """The command ends with a message that has all words, and leaves no result."""

    def problem(seen: Seen) -> str:
        for ended in seen.facts["ended"]:
            if ended.unexplained:
                return str(ended.unexplained)
            if ended.status != status:
                return f"exit status {ended.status} instead of {status}: {ended.message}"
            if told := missing(ended.stderr, words):
                return told
        return "results of a refused input" if seen.facts.get("report") else ""

    return problem


def missing(text: str, words: tuple[str, ...]) -> str:
    """Which words a text lacks; empty where it has all."""
    lacks = [word for word in words if word.lower() not in text.lower()]
    return f"not told: {', '.join(lacks)}" if lacks else ""
