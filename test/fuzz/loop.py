"""The fuzzing loop: inputs made from seeds, and from inputs that were answered in a new way.

An input whose answer differs from all before (another refusal, something else accepted) is kept to
be changed further. This leads on into a parser as coverage would, costs nothing, and works for
native libraries too. Everything follows from the seed.
"""

from __future__ import annotations

import re
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import FrameType

from fuzz.mutation import Parts
from fuzz.target import Target

from meslam_core.errors import MeslamError

MAX_CORPUS = 300
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"|b'[^']*'")
_DIGITS = re.compile(r"[0-9][0-9.e+-]*")


class HangError(BaseException):
    """One input took too long; nothing that a parser catches."""


@dataclass
class Finding:
    """An input that was neither refused nor taken well.

    Attributes:
        target: name of the target.
        kind: of the error: its type and where it was raised; one finding each is kept.
        message: of the error.
        parts: the smallest input found that raises it.
        count: of inputs that did.
    """

    target: str
    kind: str
    message: str
    parts: Parts
    count: int = 1


@dataclass
class Outcome:
    """What fuzzing a target came to.

    Attributes:
        executions: inputs tried.
        refused: of these, with an error that says so.
        seconds: of processor time [s].
        corpus: inputs that were kept, as they were answered in a new way.
        elapsed_s: time that passed, but for that of a machine that stood still [s].
        findings: by kind.
    """

    executions: int = 0
    refused: int = 0
    seconds: float = 0.0
    corpus: int = 0
    elapsed_s: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)

    def add(self, other: Outcome) -> None:
        """Count another outcome's work in."""
        self.executions += other.executions
        self.refused += other.refused
        self.seconds += other.seconds
        self.elapsed_s += other.elapsed_s
        self.corpus = max(self.corpus, other.corpus)
        for finding in other.findings.values():
            self.note(finding)

    def note(self, finding: Finding) -> None:
        """Keep the smallest input of every kind of finding."""
        known = self.findings.setdefault(finding.kind, finding)
        if known is not finding:
            known.count += finding.count
            if _size(finding.parts) < _size(known.parts):
                known.parts, known.message = finding.parts, finding.message


def fuzz(
    target: Target,
    seed: int | str,
    seconds: float,
    executions: int | None = None,
    before: Callable[[Parts], object] = lambda parts: None,
) -> Outcome:
    """Fuzz a target for so many seconds of processor time, or executions if those are fewer.

    Args:
        target: to fuzz.
        seed: of all random choices.
        seconds: of processor time [s].
        executions: at most; None for any number.
        before: called with every input before it is tried.
    """
    rng = Random(f"{target.name} {seed}")
    corpus = target.seeds()
    answers: set[str] = set()
    outcome = Outcome()
    for parts in corpus[:]:
        answer, finding = attempt(target, parts)
        if finding is not None or not answer.startswith("accepted"):
            raise AssertionError(f"{target.name}: a seed is not accepted: {answer} {finding}")
        answers.add(answer)
    started = time.process_time()
    while time.process_time() - started < seconds:
        if executions is not None and outcome.executions >= executions:
            break
        try:
            parts = target.mutate(rng.choice(corpus), corpus, rng)
        except RecursionError:
            continue  # nested so deeply that it is never changed with care
        before(parts)
        answer, finding = attempt(target, parts)
        outcome.executions += 1
        outcome.refused += answer.startswith("refused")
        if finding is not None:
            outcome.note(finding)
        elif answer not in answers and len(corpus) < MAX_CORPUS:
            answers.add(answer)
            corpus.append(parts)
    outcome.seconds = time.process_time() - started
    outcome.corpus = len(corpus)
    return outcome


def attempt(target: Target, parts: Parts) -> tuple[str, Finding | None]:
    """How a target answers an input, numbers and names left out; and what is wrong with that."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, _limited(target.seconds):
        try:
            return "accepted " + target.run(parts, Path(folder)), None
        except (MeslamError, *target.refusals) as error:
            text = str(error).replace(folder, "")
            if not text.strip():
                return "", Finding(target.name, "refused without a message", repr(error), parts)
            masked = _DIGITS.sub("0", _QUOTED.sub("''", text))
            return f"refused {type(error).__name__} {masked}", None
        except (Exception, HangError) as error:
            return "", Finding(target.name, _kind(error), repr(error)[:500], parts)


class _limited:  # noqa: N801
    """A limit on the processor time of what is done inside."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def __enter__(self) -> None:
        signal.signal(signal.SIGPROF, _interrupt)
        signal.setitimer(signal.ITIMER_PROF, self._seconds)

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise HangError("too much processor time")


def _kind(error: BaseException) -> str:
    """Type of an error and the innermost line of the product it came through."""
    if isinstance(error, HangError):
        return "HangError"
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "meslam_" in frame.filename] or frames
    return f"{type(error).__name__} in {Path(ours[-1].filename).name}:{ours[-1].name}"


def _size(parts: Parts) -> int:
    return sum(map(len, parts.values()))
