"""Fuzz every parser: python test/fuzz/run.py --minutes 60

Each target gets its turn, in a process of its own, until so much processor time is spent. Counts
add up in docs/reliability/fuzzing.json over all runs of this program, so that it may be ended and
started at any time; inputs that were neither refused nor taken well are written to a folder.
Exit status 1 when there were any.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "test"))

from fuzz.all_targets import TARGETS  # noqa: E402
from fuzz.case_file import case_name, write_case  # noqa: E402
from fuzz.loop import Outcome  # noqa: E402
from fuzz.worker import fuzz_in_process  # noqa: E402

RECORD = ROOT / "docs/reliability/fuzzing.json"
FINDINGS = ROOT / "out/fuzz"
LEAST_S = 0.1
SUMMED = ("executions", "refused", "seconds", "elapsed_s", "findings")


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("targets", nargs="*", help=f"of: {', '.join(TARGETS)}; all by default")
    parser.add_argument("--minutes", type=float, default=1.0, help="of processor time, in total")
    parser.add_argument("--turn", type=float, default=5.0, help="of one target, in seconds")
    parser.add_argument("--record", type=Path, default=RECORD, help="where counts add up")
    parser.add_argument("--findings", type=Path, default=FINDINGS, help="folder for inputs")
    given = parser.parse_args(arguments)
    chosen = [TARGETS[name] for name in given.targets or TARGETS]
    record = _read(given.record)
    given.findings.mkdir(parents=True, exist_ok=True)
    found = 0
    for target in chosen:
        record.setdefault(target.name, {"what": target.what} | _nothing())
    left_s = 60.0 * given.minutes
    while left_s > 0.0:
        # Whoever had the least so far: the work is shared out however often it is interrupted.
        target = min(chosen, key=lambda target: record[target.name]["seconds"])
        entry = record[target.name]
        outcome = fuzz_in_process(target, entry["rounds"], min(given.turn, left_s))
        left_s -= max(outcome.seconds, LEAST_S)
        _add(entry, outcome)
        for finding in outcome.findings.values():
            write_case(given.findings / case_name(finding), finding)
            print(f"  {target.name}: {finding.kind}: {finding.message[-300:]}", flush=True)
        found += len(outcome.findings)
        _write(given.record, record)
        rate = outcome.executions / max(outcome.seconds, 1e-9)
        print(
            f"{target.name:<18} {outcome.executions:>8} inputs in {outcome.seconds:6.1f} s "
            f"({rate:6.0f}/s), {outcome.refused} refused, {outcome.corpus} kept, "
            f"{len(outcome.findings)} kinds of findings",
            flush=True,
        )
    return 1 if found else 0


def _nothing() -> dict[str, Any]:
    return {
        "rounds": 0,
        "executions": 0,
        "refused": 0,
        "seconds": 0.0,
        "elapsed_s": 0.0,
        "findings": 0,
        "kinds": {},
    }


def _add(entry: dict[str, Any], outcome: Outcome) -> None:
    entry["rounds"] += 1
    entry["executions"] += outcome.executions
    entry["refused"] += outcome.refused
    entry["seconds"] = round(entry["seconds"] + outcome.seconds, 1)
    entry["elapsed_s"] = round(entry["elapsed_s"] + outcome.elapsed_s, 1)
    for finding in outcome.findings.values():
        entry["kinds"][finding.kind] = entry["kinds"].get(finding.kind, 0) + finding.count
    entry["findings"] = len(entry["kinds"])


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {}


def _write(path: Path, record: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")
    path.with_suffix(".txt").write_text("\n".join(table(record)) + "\n")


def table(record: dict[str, Any]) -> list[str]:
    """The record as lines for people; findings are kinds of errors, all of them before a fix."""
    heads = ("target", "inputs", "refused", "CPU min", "min", "findings", "what")
    rows = [heads]
    for name, entry in record.items():
        rows.append(_row(name, entry, entry["what"]))
    total = {key: sum(entry[key] for entry in record.values()) for key in SUMMED}
    rows.append(_row("all", total, ""))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place in (0, len(heads) - 1) else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _row(name: str, entry: dict[str, Any], what: str) -> tuple[str, ...]:
    minutes = (f"{entry[key] / 60.0:.1f}" for key in ("seconds", "elapsed_s"))
    refused = f"{entry['refused'] / max(entry['executions'], 1):.0%}"
    return (name, str(entry["executions"]), refused, *minutes, str(entry["findings"]), what)


if __name__ == "__main__":
    sys.exit(main())
