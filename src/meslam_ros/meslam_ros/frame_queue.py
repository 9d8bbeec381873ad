"""A bounded queue between the executor, which must never wait, and a worker, which may."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class FrameQueue(Generic[T]):
    """First in, first out; when full, the oldest entry gives way to the newest.

    Args:
        size: tells how many entries may wait, now.

    Attributes:
        dropped: entries that gave way.
    """

    def __init__(self, size: Callable[[], int]) -> None:
        self.dropped = 0
        self._size = size
        self._entries: deque[T] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        return len(self._entries)

    def put(self, entry: T) -> bool:
        """Append an entry; False when another one had to give way."""
        with self._changed:
            before = self.dropped
            while len(self._entries) >= self._size():
                self._entries.popleft()
                self.dropped += 1
            self._entries.append(entry)
            self._changed.notify()
            return self.dropped == before

    def get(self, timeout_s: float) -> T | None:
        """The oldest entry; None when none came in time or the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._closed, timeout_s)
            return self._entries.popleft() if self._entries and not self._closed else None

    def clear(self) -> None:
        """Forget what waits."""
        with self._changed:
            self._entries.clear()

    def close(self) -> None:
        """Let waiting readers go; nothing comes out any more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
