"""The frames of a recording that are to be played, decoded ahead by another thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress

from meslam_core.errors import RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings import Recording
from meslam_ros.conversions import NANOSECONDS

PREFETCHED_FRAMES = 4
POLL_S = 0.02


class FrameReader:
    """A part of a recording.

    Args:
        recording: to read.
        start_s: where to begin, from its first frame [s].
        step: every so many-th frame counts.
        limit: of the number of frames; 0 for no limit.

    Attributes:
        duration_s: from the first to the last frame of the part [s].

    Raises:
        RecordingError: when the part holds no frame.
    """

    def __init__(self, recording: Recording, start_s: float, step: int, limit: int) -> None:
        stamps_ns = recording.stamps_ns
        if len(stamps_ns) == 0:
            raise RecordingError(f"{recording.path} holds no image pair; record it again")
        start_ns = int(stamps_ns[0]) + round(start_s * NANOSECONDS)
        numbers = [n for n in range(0, len(stamps_ns), step) if stamps_ns[n] >= start_ns]
        numbers = numbers[: limit or None]
        if not numbers:
            raise RecordingError(
                f"{recording.path} has no image pair after start = {start_s} s; it lasts "
                f"{(stamps_ns[-1] - stamps_ns[0]) / NANOSECONDS:.1f} s"
            )
        self._recording = recording
        self._part = (numbers[0], numbers[-1] + 1, step)
        self._count = len(numbers)
        self.duration_s = float(stamps_ns[numbers[-1]] - stamps_ns[numbers[0]]) / NANOSECONDS

    def __len__(self) -> int:
        return self._count

    def frames(self, pause: Callable[[float], None]) -> Iterator[RgbdFrame]:
        """Decode the frames, some ahead of the one that is asked for.

        Args:
            pause: sleeps for a time [s]; what it raises ends the reading.
        """
        frames: queue.Queue[RgbdFrame | Exception | None] = queue.Queue(PREFETCHED_FRAMES)
        ended = threading.Event()
        thread = threading.Thread(target=self._decode, args=(frames, ended), daemon=True)
        thread.start()
        try:
            while True:
                pause(0.0)
                try:
                    frame = frames.get(timeout=POLL_S)
                except queue.Empty:
                    continue
                if isinstance(frame, Exception):
                    raise frame
                if frame is None:
                    return
                yield frame
        finally:
            ended.set()
            thread.join()

    def _decode(
        self, frames: queue.Queue[RgbdFrame | Exception | None], ended: threading.Event
    ) -> None:
        def put(entry: RgbdFrame | Exception | None) -> None:
            while not ended.is_set():
                with suppress(queue.Full):
                    frames.put(entry, timeout=POLL_S)
                    return

        try:
            for frame in self._recording.frames(*self._part):
                put(frame)
                if ended.is_set():
                    return
            put(None)
        except Exception as error:
            put(error)
