"""Work in a process of its own that is killed, at any time or before a chosen step."""

from __future__ import annotations

import contextlib
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest


@contextlib.contextmanager
def child(work: Callable[[], None]) -> Iterator[int]:
    """A process of its own that works until it is killed, at the latest on leaving."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads
        process = os.fork()
    if process == 0:
        try:
            work()
        finally:
            os._exit(1)
    try:
        yield process
    finally:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)


def status_of(work: Callable[[], None]) -> int:
    """With what a process of its own ends, or the signal that ended it."""
    with child(work) as process:
        return os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT).si_status


def killed_at_call(number: int, work: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> int:
    """Kill a process before its `number`-th call that changes the disk; 0 where it has fewer."""

    def work_and_die() -> None:
        calls = iter(range(1, 1000))

        def fatal(original: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any, **named: Any) -> Any:
                if next(calls) == number:
                    os.kill(os.getpid(), signal.SIGKILL)
                return original(*arguments, **named)

            return call

        for name in ("fsync", "replace", "unlink", "mkdir", "rmdir"):
            monkeypatch.setattr(os, name, fatal(getattr(os, name)))
        work()
        os._exit(0)

    return status_of(work_and_die)
