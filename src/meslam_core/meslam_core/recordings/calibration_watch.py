"""Notices a camera whose calibration changes within a recording."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any

import numpy as np

from meslam_core.recordings.messages import MessageSource

# Serialisation and stamp, in CDR, and number and stamp, in ROS 1, have as many bytes. What comes
# behind them changes only with the calibration.
HEAD_BYTES = 12
COMPARED = ("width", "height", "k", "d")

logger = logging.getLogger(__name__)


class CalibrationWatch:
    """Compares every camera info with the first one of its topic, and warns of a change, once.

    Args:
        name: of the recording, for messages.
        source: deserialises the messages.
        topics: to watch.
    """

    def __init__(self, name: str, source: MessageSource, topics: Iterable[str | None]) -> None:
        self.topics = frozenset(topic for topic in topics if topic is not None)
        self._name = name
        self._source = source
        self._first: dict[str, bytes] = {}
        self._told: set[str] = set()

    def see(self, topic: str, time_ns: int, raw: bytes) -> None:
        """Take the next serialised camera info, recorded at a time [ns]."""
        first = self._first.setdefault(topic, raw)
        if topic in self._told or raw[HEAD_BYTES:] == first[HEAD_BYTES:]:
            return
        before, now = self._fields(first, topic), self._fields(raw, topic)
        if all(np.array_equal(before[field], now[field]) for field in COMPARED):
            return
        self._told.add(topic)
        logger.warning(
            "%s: the camera info on %s changes at %.3f s (fx %.1f to %.1f, width %d to %d); the "
            "first one is used for all images. Record each calibration on its own",
            *(self._name, topic, time_ns * 1e-9),
            *(before["k"][0], now["k"][0], before["width"], now["width"]),
        )

    def _fields(self, raw: bytes, topic: str) -> dict[str, Any]:
        # ROS 1 has capitals where ROS 2 has small letters.
        message = self._source.deserialize(raw, topic)
        return {key.lower(): value for key, value in vars(message).items()}
