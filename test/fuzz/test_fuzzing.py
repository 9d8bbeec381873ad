"""A short, repeatable round of fuzzing, and every input that ever went wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz.all_targets import TARGETS
from fuzz.case_file import REGRESSIONS, read_case
from fuzz.loop import HangError, attempt, fuzz
from fuzz.mutation import Parts
from fuzz.target import Target

EXECUTIONS = 40
SECONDS = 0.4
CASES = sorted(REGRESSIONS.glob("*.json"))


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_refused_in_words(name: str) -> None:
    outcome = fuzz(TARGETS[name], 0, SECONDS, EXECUTIONS)
    assert outcome.executions > 0
    assert not outcome.findings, next(iter(outcome.findings.values()))


@pytest.mark.parametrize("path", CASES, ids=[path.stem for path in CASES])
def test_what_was_found_is_mended(path: Path) -> None:
    found = read_case(path)
    _, finding = attempt(TARGETS[found.target], found.parts)
    assert finding is None, f"{finding.kind}: {finding.message}"


def test_an_unhandled_error_and_a_hang_are_found() -> None:
    def run(parts: Parts, folder: Path) -> str:
        if parts["input"].startswith(b"hang"):
            while True:
                pass
        return str(parts["input"][0])

    target = Target("fragile", "nothing", lambda: [{"input": b"x"}], run, seconds=0.05)
    assert attempt(target, {"input": b"x"}) == ("accepted 120", None)
    _, finding = attempt(target, {"input": b""})
    assert finding is not None
    assert finding.kind.startswith("IndexError")
    _, finding = attempt(target, {"input": b"hang"})
    assert finding is not None
    assert finding.kind == HangError.__name__
