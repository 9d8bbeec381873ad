from __future__ import annotations

import threading
import time

from meslam_ros.frame_queue import FrameQueue


def test_entries_come_out_in_order() -> None:
    queue: FrameQueue[int] = FrameQueue(lambda: 3)
    assert all(queue.put(number) for number in range(3))
    assert [queue.get(0.0) for _ in range(4)] == [0, 1, 2, None]
    assert queue.dropped == 0


def test_oldest_gives_way_and_is_counted() -> None:
    queue: FrameQueue[int] = FrameQueue(lambda: 2)
    assert [queue.put(number) for number in range(5)] == [True, True, False, False, False]
    assert queue.dropped == 3
    assert [queue.get(0.0), queue.get(0.0)] == [3, 4]


def test_reader_is_woken_by_an_entry_and_by_the_end() -> None:
    queue: FrameQueue[int] = FrameQueue(lambda: 2)
    threading.Timer(0.05, queue.put, (7,)).start()
    started = time.monotonic()
    assert queue.get(5.0) == 7
    threading.Timer(0.05, queue.close).start()
    assert queue.get(5.0) is None
    assert time.monotonic() - started < 2.0
