"""What the doctor says of one thing it looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum


class Status(StrEnum):
    """How grave it is: `fail` keeps something from working, `warn` may spoil it."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True)
class Finding:
    """One thing, as it is.

    Attributes:
        subject: what was looked at.
        status: how grave it is.
        told: what was found.
        remedy: what to do about it; empty where nothing need be done.

    Raises:
        ValueError: when something is wrong and there is no remedy.
    """

    subject: str
    status: Status
    told: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if self.status is not Status.OK and not self.remedy:
            raise ValueError(f"{self.subject}: {self.told}: without a remedy")

    def to_dict(self) -> dict[str, str]:
        """Plain texts."""
        return {key: str(value) for key, value in asdict(self).items()}


Examination = Callable[[], Iterable[Finding]]
"""Looks at one area, and may take seconds."""


def ok(subject: str, told: str) -> Finding:
    """Nothing need be done."""
    return Finding(subject, Status.OK, told)


def warn(subject: str, told: str, remedy: str) -> Finding:
    """It may spoil something, or keeps a part from working that not everybody needs."""
    return Finding(subject, Status.WARN, told, remedy)


def fail(subject: str, told: str, remedy: str) -> Finding:
    """It keeps something from working."""
    return Finding(subject, Status.FAIL, told, remedy)
