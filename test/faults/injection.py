"""`python -m faults.injection NAME FOLDER CACHE MODULE`: one fault, injected here and now."""

from __future__ import annotations

import json
import sys
import time
import traceback
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

from faults.bench import Bench
from faults.catalogue import every_fault
from faults.fault import Fault, SkippedError

RESULT = "result.json"
BEGUN = "begun"


class Verdict(StrEnum):
    """As what a fault ended."""

    AS_EXPECTED = "as expected"
    MISSED = "missed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Result:
    """One fault's line of the table.

    Attributes:
        seen: in words.
        problem: why the fault was missed; empty where it was not.
    """

    name: str
    verdict: Verdict
    seen: str
    problem: str
    seconds: float

    @classmethod
    def read(cls, path: Path) -> Result:
        values = json.loads(path.read_text(encoding="utf-8"))
        return cls(**{**values, "verdict": Verdict(values["verdict"])})

    def write(self, path: Path) -> None:
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(asdict(self), indent=1), encoding="utf-8")
        partial.replace(path)


def inject(fault: Fault, bench: Bench) -> Result:
    """What was seen of a fault, and how that compares with what is expected."""
    begun = time.monotonic()
    try:
        seen = fault.inject(bench)
        words, problem = seen.words, fault.problem(seen)
    except SkippedError as error:
        return Result(fault.name, Verdict.SKIPPED, str(error), "", 0.0)
    except Exception as error:
        traceback.print_exc()
        words, problem = "", f"unexplained error: {type(error).__name__}: {error}"
    verdict = Verdict.MISSED if problem else Verdict.AS_EXPECTED
    return Result(fault.name, verdict, words, problem, time.monotonic() - begun)


def main(name: str, folder: Path, cache: Path, module: str) -> None:
    fault = next(fault for fault in every_fault([module]) if fault.name == name)
    (folder / BEGUN).touch()
    inject(fault, Bench(folder / "bench", cache)).write(folder / RESULT)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4])
