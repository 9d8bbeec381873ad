"""Reading and odometry in a thread of their own, ahead of tracking."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass

from meslam_core.frame import RgbdFrame
from meslam_core.odometry import Odometry, OdometryEstimate

STOP_CHECK_S = 0.1


@dataclass(frozen=True)
class TimedFrame:
    """A frame with its odometry.

    Attributes:
        frame: the image pair.
        odometry: its estimate.
        odometry_ms: time that took.
        reading_ms: time it took to get the frame, with decoding and registration of its depth, or
            the wait for it.
    """

    frame: RgbdFrame
    odometry: OdometryEstimate
    odometry_ms: float
    reading_ms: float


class OdometryWorker:
    """Yields frames with their odometry, which another thread finds meanwhile.

    Args:
        frames: to take; read by the other thread alone.
        odometry: likewise.
        ahead: at most so many frames are ready and wait.
    """

    def __init__(self, frames: Iterable[RgbdFrame], odometry: Odometry, ahead: int) -> None:
        self._frames = frames
        self._odometry = odometry
        self._ready: queue.Queue[TimedFrame | BaseException | None] = queue.Queue(ahead)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="meslam-odometry", daemon=True)

    @property
    def waiting(self) -> bool:
        """Whether a frame is ready that nobody has taken."""
        return not self._ready.empty()

    def __iter__(self) -> Generator[TimedFrame, None, None]:
        """The frames; what reading or odometry raises is raised after the frames before it."""
        self._thread.start()
        try:
            while (ready := self._ready.get()) is not None:
                if isinstance(ready, BaseException):
                    raise ready
                yield ready
        finally:
            self._stop.set()
            self._thread.join()

    def _run(self) -> None:
        last: BaseException | None = None
        try:
            asked = time.perf_counter()
            for frame in self._frames:
                started = time.perf_counter()
                estimate = self._odometry.process(frame)
                ended = time.perf_counter()
                odometry_ms, reading_ms = (ended - started) * 1e3, (started - asked) * 1e3
                if not self._put(TimedFrame(frame, estimate, odometry_ms, reading_ms)):
                    return
                asked = time.perf_counter()
        except BaseException as error:
            last = error
        self._put(last)

    def _put(self, item: TimedFrame | BaseException | None) -> bool:
        """Hand an item over when there is room; False when nobody wants it any more."""
        while not self._stop.is_set():
            try:
                self._ready.put(item, timeout=STOP_CHECK_S)
            except queue.Full:
                continue
            return True
        return False
