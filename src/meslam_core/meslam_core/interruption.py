"""A request to stop that leaves time to write what there is."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


@contextmanager
def stop_request() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; the second one has its usual effect."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    usual: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in usual.items():
            signal.signal(number, handler)

    def request(_: int, __: FrameType | None) -> None:
        event.set()
        restore()

    for number in (signal.SIGINT, signal.SIGTERM):
        usual[number] = signal.signal(number, request)
    try:
        yield event
    finally:
        restore()
