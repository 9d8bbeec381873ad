"""A place in the map where a lost camera was recognised."""

from __future__ import annotations

from dataclasses import dataclass

from meslam_core.regions.region import Region
from meslam_core.tracking.field_tracker import Alignment


@dataclass(frozen=True)
class Sighting:
    """A pose at which the map shows what a frame shows.

    Attributes:
        region: whose map it is, awake.
        alignment: with that map.
        keyframe: whose image the frame was registered with; None where it was the map alone.
    """

    region: Region
    alignment: Alignment
    keyframe: int | None
