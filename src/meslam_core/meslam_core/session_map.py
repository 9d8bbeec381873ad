"""Storing what a session mapped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion, snapshot
from meslam_core.slam import Slam


def write_map(slam: Slam, stamp_ns: int, path: Path, map_id: str | None = None) -> int:
    """Store the map of all frames up to a stamp and return its size [bytes].

    What an earlier session stored and this one did not change is written as it was.

    Args:
        slam: no training runs.
        stamp_ns: of the last frame [ns].
        path: of the map's folder.
        map_id: of the map; a new one by default.
    """
    if slam.atlas is None:
        return 0
    store = MapStore(path)
    regions = _snapshots(slam, stamp_ns)
    store.save(regions, slam.atlas.grid, map_id, precision=slam.config.map.codec)
    return store.map_bytes


def _snapshots(slam: Slam, stamp_ns: int) -> Iterator[StoredRegion | bytes]:
    """The regions one after the other: those at rest are in memory only while they are written."""
    assert slam.atlas is not None
    active = slam.atlas.active
    for region in slam.atlas.regions.values():
        if region.origin is not None and region.untouched:
            yield region.origin.data
            continue
        trained = slam.keyframes.stamps_ns[max(region.keyframes)]
        newest = stamp_ns if any(region is each for each in active) else trained
        yield snapshot(region, newest)
