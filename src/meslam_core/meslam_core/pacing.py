"""Frames at the pace at which they were recorded, as a camera would deliver them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

from meslam_core.frame import RgbdFrame


class PacedFrames:
    """Yields frames when they are due; of several that are due, only the newest.

    That is what a live subscription with a queue of one does: whoever is slower than the camera
    misses frames, and never works on an old one. The clock starts with the first frame.

    Args:
        frames: in the order of their stamps.
        clock: seconds, monotonic.
        sleep: waits for seconds.

    Attributes:
        skipped: how many frames were passed over so far.
    """

    def __init__(
        self,
        frames: Iterable[RgbdFrame],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._frames = iter(frames)
        self._clock = clock
        self._sleep = sleep
        self.skipped = 0
        self._started_s = 0.0
        self._first_stamp_ns = 0
        self._error: Exception | None = None

    def __iter__(self) -> Iterator[RgbdFrame]:
        pending, following = self._next(), self._next()
        first_stamp_ns = 0 if pending is None else pending.stamp_ns
        started = self._clock()
        self._started_s, self._first_stamp_ns = started, first_stamp_ns
        while pending is not None:
            wait_s = -self.lateness_s(pending.stamp_ns)
            if wait_s > 0:
                self._sleep(wait_s)
            now_ns = first_stamp_ns + round((self._clock() - started) * 1e9)
            while following is not None and following.stamp_ns <= now_ns:
                pending, following = following, self._next()
                self.skipped += 1
            yield pending
            # Read after the frame has been worked on: a camera's images need not be read.
            pending, following = following, self._next()
        if self._error is not None:
            raise self._error

    def lateness_s(self, stamp_ns: int) -> float:
        """How long ago a frame was due [s]; negative while it is not yet."""
        due_s = self._started_s + (stamp_ns - self._first_stamp_ns) * 1e-9
        return self._clock() - due_s

    def _next(self) -> RgbdFrame | None:
        """The next frame; an error waits until the frames before it have been yielded."""
        try:
            return next(self._frames, None)
        except Exception as error:
            self._error = error
            return None
