"""What the `meslam` command says on the terminal beside its results: standard error alone."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from meslam_core.command_output import printable

if TYPE_CHECKING:
    from meslam_core.slam import FrameResult

RATE_MEMORY = 0.9


def error_console() -> Console:
    """A console on standard error that leaves texts as they are."""
    return Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)


class ConsoleHandler(logging.Handler):
    """Shows the library's warnings; a progress bar stays below them."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record on today's standard error, which a progress bar may have replaced."""
        told = printable(record.getMessage())
        print(f"meslam: {record.levelname.lower()}: {told}", file=sys.stderr)


class RunBar:
    """A progress bar that tells how tracking and mapping are doing (a `RunProgress`)."""

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description:<12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[details]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._task: TaskID | None = None
        self._keyframes = 0
        self._interval_s: float | None = None
        self._last = time.perf_counter()

    def __enter__(self) -> RunBar:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def started(self, frames: int) -> None:
        """Show the bar."""
        self._task = self._progress.add_task("starting", total=frames, details="")
        self._last = time.perf_counter()

    def processed(self, offered: int, result: FrameResult) -> None:
        """Advance to frame number `offered` and show its state."""
        assert self._task is not None
        now = time.perf_counter()
        interval, self._last = now - self._last, now
        if self._interval_s is None:
            self._interval_s = interval
        self._interval_s = RATE_MEMORY * self._interval_s + (1 - RATE_MEMORY) * interval
        self._keyframes += result.is_keyframe
        details = (
            f"{1.0 / max(self._interval_s, 1e-6):4.1f} frames/s, {self._keyframes} keyframes, "
            f"residual {result.residual_m * 1e3:.1f} mm"
        )
        self._progress.update(
            self._task, completed=offered, description=result.state.name, details=details
        )

    def stage(self, name: str) -> None:
        """Show what is done after the frames."""
        if self._task is not None:
            self._progress.update(self._task, description=name)

    def refined(self, done: int, total: int) -> None:
        """Let the bar tell how far refining is, from its start."""
        if self._task is not None:
            self._progress.update(self._task, completed=done, total=total, details="steps")


@contextmanager
def counting_bar(console: Console, description: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar behind a function of what is done and the total."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    ) as progress:
        task = progress.add_task(description, total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        yield show


@contextmanager
def waiting(description: str) -> Iterator[None]:
    """A sign of life on a terminal while something takes its time, without an end in sight."""
    with error_console().status(description):
        yield
