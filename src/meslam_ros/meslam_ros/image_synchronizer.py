"""Pairs colour with depth images by their stamps."""

from __future__ import annotations

import time
from bisect import insort
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from sensor_msgs.msg import Image

from meslam_ros.conversions import NANOSECONDS, stamp_ns

MAX_WAITING = 30
RESTART_S = 1.0


@dataclass(frozen=True)
class ImagePair:
    """A colour and a depth image taken together.

    Attributes:
        stamp_ns: of the colour image, which stamps everything that follows from the pair [ns].
        color, depth: the messages.
        arrival_s: when the pair was complete, `time.monotonic` [s].
    """

    stamp_ns: int
    color: Image
    depth: Image
    arrival_s: float


@dataclass(frozen=True, eq=False)
class _Waiting:
    """An image that has no partner yet; `arrival` counts them."""

    stamp_ns: int
    arrival: int
    message: Image


class ImageSynchronizer:
    """Collects images of two topics until each has its partner.

    Equal and nearly equal stamps pair at once. Others pair with the nearest stamp within the
    tolerance, once a later image shows that no nearer one comes. Pairs come out with increasing
    stamps; when stamps jump back by more than a second, a recording began again, and so does this.

    Args:
        tolerance_s: largest difference of stamps [s].

    Attributes:
        tolerance_s: may change at any time [s].
        dropped: counts of images that found no partner, by reason.
    """

    def __init__(self, tolerance_s: float) -> None:
        self.dropped: Counter[str] = Counter()
        self.tolerance_s = tolerance_s
        self._color: list[_Waiting] = []
        self._depth: list[_Waiting] = []
        self._arrived = 0
        self._last_pair_ns: int | None = None

    @property
    def apart_s(self) -> float | None:
        """By how much the stamps of the newest images differ [s]; None without one of both."""
        if not self._color or not self._depth:
            return None
        newest = [max(w, key=lambda entry: entry.arrival) for w in (self._color, self._depth)]
        return abs(newest[0].stamp_ns - newest[1].stamp_ns) / NANOSECONDS

    @property
    def _tolerance_ns(self) -> int:
        return round(self.tolerance_s * NANOSECONDS)

    def add_color(self, message: Image) -> Iterator[ImagePair]:
        """Take a colour image; yields the pairs that are complete now."""
        return self._add(self._color, message, "colour image", 0)

    def add_depth(self, message: Image) -> Iterator[ImagePair]:
        """Take a depth image; yields the pairs that are complete now."""
        return self._add(self._depth, message, "depth image", self._tolerance_ns)

    def _add(
        self, waiting: list[_Waiting], message: Image, name: str, lateness_ns: int
    ) -> Iterator[ImagePair]:
        stamp = stamp_ns(message.header.stamp)
        self._notice_restart(stamp)
        if self._last_pair_ns is not None and stamp <= self._last_pair_ns - lateness_ns:
            self.dropped[f"{name} came too late"] += 1
            return
        self._arrived += 1
        insort(waiting, _Waiting(stamp, self._arrived, message), key=lambda entry: entry.stamp_ns)
        if len(waiting) > MAX_WAITING:
            # Not the one with the earliest stamp: others with wrong ones would stay for ever.
            waiting.remove(min(waiting, key=lambda entry: entry.arrival))
            self.dropped[f"{name} without partner"] += 1
        while (pair := self._next_pair()) is not None:
            yield pair

    def _notice_restart(self, stamp: int) -> None:
        last = self._last_pair_ns
        if last is not None and stamp < last - RESTART_S * NANOSECONDS:
            self._last_pair_ns = None
            self._color.clear()
            self._depth.clear()

    def _next_pair(self) -> ImagePair | None:
        """The earliest pair that no image still to come could improve."""
        depth_ns = [entry.stamp_ns for entry in self._depth]
        if not depth_ns:
            return None
        for place, entry in enumerate(self._color):
            stamp = entry.stamp_ns
            differences = [abs(other - stamp) for other in depth_ns]
            difference = min(differences)
            nearest = differences.index(difference)
            # No camera is so fast that its next image would be nearer than a quarter.
            certain = 4 * difference <= self._tolerance_ns or depth_ns[-1] > stamp
            if difference <= self._tolerance_ns and certain:
                return self._take(place, nearest)
            if not certain:
                return None
        return None

    def _take(self, color_place: int, depth_place: int) -> ImagePair:
        """Remove a pair, and what came before it without finding a partner."""
        self.dropped["colour image without partner"] += color_place
        self.dropped["depth image without partner"] += depth_place
        stamp, color = self._color[color_place].stamp_ns, self._color[color_place].message
        depth = self._depth[depth_place].message
        del self._color[: color_place + 1]
        del self._depth[: depth_place + 1]
        self._last_pair_ns = stamp
        return ImagePair(stamp, color, depth, time.monotonic())
