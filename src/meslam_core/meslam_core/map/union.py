"""Several maps in one frame, as of two robots in neighbouring rooms, taken as one."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from meslam_core.config import MapConfig
from meslam_core.errors import MapError
from meslam_core.map import codec
from meslam_core.map.manifest import OFF_LATTICE
from meslam_core.map.metadata import MAX_INDEX
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.reader import LoadedMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid, RegionIndex

LATTICE_TOLERANCE_M = 1e-6


class MapUnion:
    """Maps in a common frame: regions side by side, blended where they overlap.

    Lattices may differ and indices may clash, for a region's pose tells where it is. A region
    that several maps hold in equal copies counts once.

    Args:
        paths: of map stores.

    Raises:
        MapError: when one is no map or nothing of it can be read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.maps: list[LoadedMap] = [MapStore(path).load() for path in paths]

    @property
    def regions(self) -> list[StoredRegion]:
        """The regions of all maps; indices may clash."""
        return [region for _, region in self._distinct()]

    @property
    def damages(self) -> list[str]:
        """A sentence for every damage found."""
        return [warning for each in self.maps for warning in each.warnings]

    def neural_map(self, config: MapConfig | None = None, backend: str = "auto") -> NeuralMap:
        """The maps as one that answers; raises as `NeuralMap`."""
        return NeuralMap(self.regions, config, backend)

    def save(self, path: Path) -> int:
        """Store the maps as one, with an identity of its own; returns the number of regions.

        The first map's lattice and pose graph are kept. Regions of the others keep their index
        where it lies on that lattice and is free, else `OFF_LATTICE` or a multiple of it is
        added. Nothing is quantised anew.

        Raises:
            OutputError: when the folder cannot be written.
            MapError: when maps made with different settings cannot be joined.
        """
        self.neural_map()
        stored: dict[RegionIndex, bytes] = {}
        for owner, region in self._distinct():
            data, index = owner.encoded[region.index], region.index
            if index in stored or not _same_lattice(owner.grid, self.maps[0].grid):
                index = _free_index(index, stored)
                data = codec.with_index(data, index)
            stored[index] = data
        first = self.maps[0]
        MapStore(path).save(stored.values(), first.grid, uuid.uuid4().hex, nodes=first.nodes)
        return len(stored)

    def _distinct(self) -> Iterator[tuple[LoadedMap, StoredRegion]]:
        seen: set[bytes] = set()
        for each in self.maps:
            for region in each.regions:
                content = _content(region)
                if content not in seen:
                    seen.add(content)
                    yield each, region


def _content(region: StoredRegion) -> bytes:
    """A digest of what a region answers."""
    parts = (region.T_map_region, region.parameters, region.mask.flags)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).digest()


def _same_lattice(one: RegionGrid, other: RegionGrid) -> bool:
    ours, theirs = ([*grid.origin, grid.side_m, grid.spacing_m] for grid in (one, other))
    return bool(np.allclose(ours, theirs, rtol=0.0, atol=LATTICE_TOLERANCE_M))


def _free_index(index: RegionIndex, taken: Iterable[RegionIndex]) -> RegionIndex:
    x, y, z = index
    used = set(taken)
    for level in range(z + OFF_LATTICE, MAX_INDEX, OFF_LATTICE):
        if (x, y, level) not in used:
            return (x, y, level)
    raise MapError(f"there is no free index left for region {index}; merge fewer maps")
