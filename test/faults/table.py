"""The table of faults as a page and as JSON."""

from __future__ import annotations

import json
import os
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from faults.fault import Fault, Group
from faults.injection import Result, Verdict

from meslam_core import __version__

INTRODUCTION = """\
# Reliability: what happens when something is wrong

`make faults` wrote this page. It injects every fault below into the system, each in a process of
its own with a limit on its time, and compares what it sees with what is expected. Apart from the
last column, the same holds for all of them, and is checked for all of them:

- nothing hangs: what goes on for longer than its limit is missed;
- nothing ends without an explanation: a traceback, a signal, or an exit status that is not
  documented is missed;
- no map is lost: every map that was stored before or during the fault loads whole afterwards,
  except where the fault itself damages the stored map.

What the fuzzers did and how whole runs were killed at random is in [reliability/](reliability/).
"""
TITLES = {
    Group.INPUT: "Images, stamps and calibration",
    Group.RECORDING: "Recordings and files that are damaged",
    Group.STORAGE: "The map's folder and the results'",
    Group.LOAD: "Too much, too fast, too slow",
    Group.LIVE: "The running nodes",
    Group.SECURITY: "Malicious input",
}


def summary(results: Sequence[Result], wall_s: float | None) -> str:
    """The counts in one sentence; without a time where several runs made them."""
    counts = Counter(result.verdict for result in results)
    told = [f"{counts[verdict]} {verdict}" for verdict in Verdict if counts[verdict]]
    time = "" if wall_s is None else f", in {wall_s / 60:.1f} minutes"
    return f"{len(results)} faults: {', '.join(told)}{time}."


def write(
    page: Path, faults: Sequence[Fault], results: dict[str, Result], wall_s: float | None
) -> None:
    """Write the page, and the same as JSON beside it."""
    ran = [results[fault.name] for fault in faults]
    lines = [
        INTRODUCTION,
        f"MeSLAM {__version__}, Python {platform.python_version()}, {platform.machine()}, "
        f"{os.cpu_count()} cores. {summary(ran, wall_s)}",
    ]
    for group in Group:
        chapter = [fault for fault in faults if fault.group == group]
        if not chapter:
            continue
        lines += ["", f"## {TITLES[group]}", ""]
        lines += [
            "| fault | injected | expected | seen | s | verdict |",
            "|---|---|---|---|---|---|",
        ]
        for fault in chapter:
            result = results[fault.name]
            seen = _cell("; ".join(filter(None, (result.seen, result.problem))))
            lines.append(
                f"| `{fault.name}` | {fault.injected} | {fault.expected} | {seen} "
                f"| {result.seconds:.1f} | {result.verdict} |"
            )
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    entries = [
        {
            **asdict(results[fault.name]),
            "group": fault.group,
            "injected": fault.injected,
            "expected": fault.expected,
        }
        for fault in faults
    ]
    values = {"meslam": __version__, "wall_s": wall_s and round(wall_s, 1), "faults": entries}
    page.with_suffix(".json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def _cell(text: str) -> str:
    """A text that stays in its cell."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
