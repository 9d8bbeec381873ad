"""Whether this computer is too slow for its camera."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

WINDOW_S = 5.0
MIN_PAIRS = 5


class Overload:
    """Compares how many image pairs came with how many were skipped, over the last seconds.

    Args:
        share: of skipped pairs from which the computer is too slow; 1 never.
        clock: gives the time [s].
    """

    def __init__(
        self, share: Callable[[], float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._share = share
        self._clock = clock
        self._counts: deque[tuple[float, int, int]] = deque([(clock(), 0, 0)])

    def count(self, came: int, skipped: int) -> str:
        """Take what was counted so far; why the computer is too slow, empty when it is not.

        Args:
            came: image pairs since the start, those lost on their way included.
            skipped: of these, those that nobody had time for.
        """
        now = self._clock()
        self._counts.append((now, came, skipped))
        while len(self._counts) > 1 and self._counts[1][0] <= now - WINDOW_S:
            self._counts.popleft()
        _, came_before, skipped_before = self._counts[0]
        came, skipped = came - came_before, skipped - skipped_before
        if came < MIN_PAIRS or skipped < self._share() * came or self._share() >= 1.0:
            return ""
        return (
            f"overloaded: {skipped} of the last {came} image pairs were skipped, for this computer "
            "is slower than the camera"
        )
