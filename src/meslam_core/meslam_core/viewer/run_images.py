"""The images of a finished run, decoded beside the replay."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MeslamError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings.recording import Recording
from meslam_core.viewer.camera_image import reduced

logger = logging.getLogger(__name__)

# So far ahead reading on is faster than looking for the place.
NEAR_FRAMES = 20


class RunImages:
    """Shows the recording's image of a time when it is decoded; what is asked for between is not.

    Args:
        recording: open; used by one thread of this object alone.
        show: takes (H, W, 3) uint8 RGB.
    """

    def __init__(self, recording: Recording, show: Callable[[NDArray[np.uint8]], None]) -> None:
        self._recording = recording
        self._show = show
        self._stamps_ns = recording.stamps_ns
        self._frames: Iterator[RgbdFrame] | None = None
        self._next = 0
        self._wanted: int | None = None
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="viewer images", daemon=True)
        self._thread.start()

    def seek(self, stamp_ns: int) -> None:
        """Ask for the image nearest to a time [ns]."""
        after = int(np.searchsorted(self._stamps_ns, stamp_ns))
        near = [n for n in (after - 1, after) if 0 <= n < len(self._stamps_ns)]
        with self._changed:
            self._wanted = min(near, key=lambda n: abs(int(self._stamps_ns[n]) - stamp_ns))
            self._changed.notify()

    def close(self) -> None:
        """Stop; the recording is left open."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted is not None or self._stopping)
                if self._stopping:
                    return
                number, self._wanted = self._wanted, None
            assert number is not None
            try:
                self._show(reduced(self._frame(number).color))
            except MeslamError as error:
                logger.warning("the image is not shown: %s", error)
            except StopIteration:
                logger.warning("the recording ends before image %d", number)

    def _frame(self, number: int) -> RgbdFrame:
        """Decode one pair of the recording."""
        if self._frames is None or not self._next <= number < self._next + NEAR_FRAMES:
            self._frames, self._next = iter(self._recording.frames(number)), number
        while self._next < number:
            next(self._frames)
            self._next += 1
        self._next += 1
        return next(self._frames)
