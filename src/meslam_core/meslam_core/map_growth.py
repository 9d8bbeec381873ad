"""How large a map is while it grows, without slowing what makes it grow."""

from __future__ import annotations

import contextlib
import time
from concurrent.futures import Future, ThreadPoolExecutor

from meslam_core.errors import MapError
from meslam_core.map.codec import encode
from meslam_core.map.stored_region import StoredRegion, snapshot
from meslam_core.regions.grid import RegionIndex
from meslam_core.slam import Slam

# Measuring takes at most this share of a core.
SHARE = 0.01


class MapGrowth:
    """Measures the map's size now and then, in a thread of its own.

    Encoding a region takes about a tenth of a second. So only the working one is measured, and it
    takes a hundred times as long until the next one is; a region keeps the size that it had when
    it last worked, and one that never did counts like the last one measured.

    Args:
        precision: of the stored weights.
    """

    def __init__(self, precision: str) -> None:
        self._precision = precision
        self._sizes: dict[RegionIndex, int] = {}
        self._latest = 0
        self._due_s = float("-inf")
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="meslam-size")
        self._running: Future[None] | None = None

    def measured_bytes(self, slam: Slam, stamp_ns: int) -> int | None:
        """The size as last measured; None before that. Begins to measure again where it is time.

        Args:
            slam: whose map it is; called by the thread that tracks.
            stamp_ns: of the latest image [ns].
        """
        if self._running is not None and self._running.done():
            self._running.result()
            self._running = None
        view = slam.working_view
        if view is not None and self._running is None and time.monotonic() >= self._due_s:
            self._running = self._thread.submit(self._measure, snapshot(view, stamp_ns))
        if slam.atlas is None or not self._sizes:
            return None
        others = len(slam.atlas.regions) - len(self._sizes)
        return sum(self._sizes.values()) + max(others, 0) * self._latest

    def close(self) -> None:
        """Wait for the measurement that runs."""
        self._thread.shutdown(wait=True)

    def _measure(self, region: StoredRegion) -> None:
        started = time.monotonic()
        # What cannot be stored now is refused, with the reason, when it is to be stored.
        with contextlib.suppress(MapError):
            self._latest = len(encode(region, self._precision))
            self._sizes[region.index] = self._latest
        ended = time.monotonic()
        self._due_s = ended + (ended - started) / SHARE
