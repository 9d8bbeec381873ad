"""What a fault is: what is injected, what is expected in words, and what must then hold."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from faults.bench import Bench

NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")


class Group(StrEnum):
    """What kind of fault; a chapter of the table each."""

    INPUT = "input"
    RECORDING = "recording"
    STORAGE = "storage"
    LOAD = "load"
    LIVE = "live"
    SECURITY = "security"


class SkippedError(Exception):
    """This machine cannot inject the fault; the message says what it lacks."""


@dataclass(frozen=True)
class Seen:
    """What came of a fault.

    Attributes:
        words: one line for the table.
        facts: what the predicate asks about; anything.
    """

    words: str
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """One line of the table.

    Attributes:
        name: of lower-case words with hyphens; unique.
        group: the chapter.
        injected: what is done to the system, for people.
        expected: what must then happen, for people.
        inject: does it in a process of its own, and tells what was seen; raises `SkippedError`
            where the machine cannot do it. Whatever else it raises is a miss.
        problem: what of the expectation does not hold; empty where all of it does.
        limit_s: of its own time on a machine with nothing else to do; more is a hang.
        quick: whether it runs in CI.
        alone: whether nothing else may run beside it.
        harmed: names of map folders that the fault itself damages. Every other `*.meslam` folder
            that it leaves behind must load whole.
    """

    name: str
    group: Group
    injected: str
    expected: str
    inject: Callable[[Bench], Seen]
    problem: Callable[[Seen], str]
    limit_s: float = 120.0
    quick: bool = False
    alone: bool = False
    harmed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"{self.name!r} is no name of a fault, as in 'depth-all-zero'")
        for text in (self.injected, self.expected):
            if not text or "|" in text or "\n" in text:
                raise ValueError(f"{self.name}: {text!r} does not fit into a table")
        if not 0.0 < self.limit_s <= 300.0:
            raise ValueError(f"{self.name}: a limit of {self.limit_s} s; the whole table has 1200")


def faults_of(group: Group) -> Callable[..., Fault]:
    """A function that makes faults of one group, from all that is the fault's own."""

    def fault(
        name: str,
        injected: str,
        expected: str,
        inject: Callable[[Bench], Seen],
        problem: Callable[[Seen], str],
        **options: Any,
    ) -> Fault:
        return Fault(name, group, injected, expected, inject, problem, **options)

    return fault
