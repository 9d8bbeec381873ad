"""Training in a thread of its own, so that tracking never waits for a step of it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from meslam_core.mapping.joint_optimizer import StepLosses


@dataclass(frozen=True)
class Training:
    """What one job did.

    Attributes:
        losses: of its steps on the working region.
        duration_ms: of the job.
    """

    losses: StepLosses = field(default_factory=StepLosses)
    duration_ms: float = 0.0


class TrainingWorker:
    """Runs one job at a time; the caller goes on meanwhile and takes the result when it wants to.

    The thread lives as long as the worker; the compiled kernel leaves the interpreter to others
    while it computes.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(max_workers=1, thread_name_prefix="meslam-mapping")
        self._running: Future[Training] | None = None

    def start(self, job: Callable[[], Training]) -> None:
        """Begin a job; the one before must have been waited for."""
        assert self._running is None
        self._running = self._threads.submit(job)

    def wait(self) -> Training | None:
        """The result of the running job, or None where none runs; raises what the job raised."""
        running, self._running = self._running, None
        return None if running is None else running.result()

    def settle(self) -> None:
        """Wait until the running job has ended; its result stays for `wait`."""
        if self._running is not None:
            self._running.exception()

    def close(self) -> None:
        """Wait for the job and end the thread."""
        self._threads.shutdown(wait=True)
