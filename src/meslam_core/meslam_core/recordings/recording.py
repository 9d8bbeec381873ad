"""What every recording offers, whatever its format."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame


@runtime_checkable
class Recording(Protocol):
    """A sequence of registered RGB-D frames in the order of their stamps."""

    name: str
    path: Path
    format: str
    """Name of the format, for people."""
    topics: dict[str, str]
    """Topics that are read, by role (color, depth, ...); empty for image files."""

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the colour camera, to which depth is registered."""
        ...

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of all pairs [ns], shape (len,), strictly increasing; decodes no image."""
        ...

    def __len__(self) -> int:
        """Number of colour-depth pairs."""
        ...

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """Decode the pairs `start:stop:step`, one at a time; a fresh iterator every call.

        Raises:
            RecordingError: when the data ends or is damaged; the message names file and frame.
        """
        ...

    def close(self) -> None:
        """Release files; idempotent."""
        ...
