"""A recording that is nothing but frames in memory, and may break off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame


@dataclass
class MemoryRecording:
    """Frames, and an error that is raised after the last one where one is given."""

    images: list[RgbdFrame]
    error: Exception | None = None
    name: str = "memory"
    path: Path = Path("memory")
    format: str = "memory"
    topics: dict[str, str] = field(default_factory=dict)

    @property
    def camera(self) -> PinholeCamera:
        """Of all frames."""
        return self.images[0].camera if self.images else PinholeCamera(4, 3, 1.0, 1.0, 1.0, 1.0)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Of all frames [ns]."""
        return np.array([image.stamp_ns for image in self.images], np.int64)

    def __len__(self) -> int:
        return len(self.images)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """The frames `start:stop:step`, then the error."""
        yield from islice(self.images, start, stop, step)
        if self.error is not None and stop is None:
            raise self.error

    def close(self) -> None:
        """Nothing to release."""
