"""When which image of a recording is due, and what time it is in the recording meanwhile."""

from __future__ import annotations

from meslam_ros.conversions import NANOSECONDS


class Pace:
    """Recording time against this computer's, at a rate that may change and with pauses."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._due_s = 0.0

    def next(self, stamp_ns: int, now_s: float, rate: float) -> float:
        """When the next image is due; the first one, and every one with rate 0, is due at once.

        Args:
            stamp_ns: of the image [ns].
            now_s: this computer's steady clock [s].
            rate: seconds of the recording a second.
        """
        if self._stamp_ns is None or rate <= 0:
            self._due_s = now_s
        else:
            self._due_s += (stamp_ns - self._stamp_ns) / NANOSECONDS / rate
        self._stamp_ns = stamp_ns
        return self._due_s

    def paused(self, seconds: float) -> None:
        """Put everything that follows off."""
        self._due_s += seconds


class Progress:
    """How far playback is, for people, from time to time.

    Args:
        frames: of the part that is played.
        duration_s: of that part [s].
        period_s: between two reports.
    """

    def __init__(self, frames: int, duration_s: float, period_s: float) -> None:
        self._frames = frames
        self._duration_s = duration_s
        self._period_s = period_s
        self._first_ns: int | None = None
        self._count = 0
        self._reported_s: float | None = None

    def report(self, stamp_ns: int, now_s: float) -> str | None:
        """Count an image that was sent; what to say, when it is time to say something.

        Args:
            stamp_ns: of the image [ns].
            now_s: this computer's steady clock [s].
        """
        self._count += 1
        if self._first_ns is None or self._reported_s is None:
            self._first_ns, self._reported_s = stamp_ns, now_s
            return None
        if now_s - self._reported_s < self._period_s:
            return None
        self._reported_s = now_s
        played_s = (stamp_ns - self._first_ns) / NANOSECONDS
        return (
            f"{100 * self._count // self._frames} %: {self._count} of {self._frames} image pairs, "
            f"{played_s:.1f} of {self._duration_s:.1f} s"
        )
