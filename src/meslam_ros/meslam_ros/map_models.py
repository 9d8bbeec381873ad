"""The map server's map: the stored networks of its regions, and nothing else."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meslam_core.config import MeslamConfig
from meslam_core.errors import MapError
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.reader import LoadedMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.map.surface import MapSurfaces
from meslam_core.regions.grid import RegionGrid, RegionIndex
from meslam_interfaces.msg import RegionArray, RegionModel
from meslam_ros.region_catalog import RegionCatalog, RegionEntry, model_name
from meslam_ros.region_messages import encoded_model, stored_region


@dataclass(frozen=True)
class MapSnapshot:
    """The map at one instant; later changes make a new one.

    Attributes:
        map_id: of the map.
        stamp_ns: of the newest image in it [ns].
        versions: of its regions.
        map: that answers.
        surfaces: its surfaces and the distances to them.
    """

    map_id: str
    stamp_ns: int
    versions: dict[RegionIndex, int]
    map: NeuralMap
    surfaces: MapSurfaces


@dataclass(frozen=True)
class MapContent:
    """What a store holds of a map.

    Attributes:
        map_id: of the map.
        versions: of its regions.
        data: the regions' files.
        grid: the lattice; None where there is no region.
    """

    map_id: str
    versions: dict[RegionIndex, int]
    data: list[bytes]
    grid: RegionGrid | None

    def write(self, store: MapStore) -> None:
        """Make a store hold this map.

        Raises:
            OutputError: when the folder cannot be written.
        """
        assert self.grid is not None
        store.save(self.data, self.grid, self.map_id)


class MapModels:
    """Takes models, checks them, and keeps the newest of each region; usable from any thread.

    Args:
        config: of the map's answers and of the lattice.
        map_frame: of the regions' poses.
        max_bytes: tells how much memory models that are sent may take [bytes].

    Attributes:
        before_replacing: called with the identity of a map before that takes the place of the one
            that is there.
    """

    def __init__(
        self,
        config: MeslamConfig,
        map_frame: str,
        max_bytes: Callable[[], float] = lambda: math.inf,
    ) -> None:
        self.before_replacing: Callable[[str], None] = lambda map_id: None
        self._catalog = RegionCatalog()
        self._config = config
        self._map_frame = map_frame
        self._max_bytes = max_bytes
        self._lattice: RegionGrid | None = None
        self._regions: dict[RegionIndex, PlacedRegion] = {}
        self._data: dict[RegionIndex, bytes] = {}
        self._live_map_id = ""
        self._replaced_map_id = ""
        self._snapshot: MapSnapshot | None = None
        self._surfaces: MapSurfaces | None = None
        self._lock = threading.RLock()

    def add(self, model: RegionModel) -> bool:
        """Take a region's model; whether it changed the map.

        A model of another map replaces the map, unless that map was itself replaced by loading
        a stored one: the loaded map stays until tracking begins a new one.

        Raises:
            MapError: when the model is damaged, of another format, contradicts itself, or the map
                would become too large with it.
        """
        with self._lock:
            if not self._is_wanted(model):
                return False
        stored = stored_region(model)
        self._check_size(model, stored)
        region = self._placed(stored)
        if model.map_id != self.map_id:
            self.before_replacing(model.map_id)
        with self._lock:
            if not self._is_wanted(model):
                return False
            self._live_map_id = model.map_id
            if model.map_id != self._catalog.map_id:
                self._begin(model.map_id)
            self._catalog.add(RegionEntry.of(model))
            self._regions[region.stored.index] = region
            self._data[region.stored.index] = bytes(model.data)
            self._snapshot = None
            return True

    def _check_size(self, model: RegionModel, region: StoredRegion) -> None:
        with self._lock:
            regions = self._regions if model.map_id == self._catalog.map_id else {}
            others = (other.stored for i, other in regions.items() if i != region.index)
            needed = region.size_in_memory + sum(other.size_in_memory for other in others)
        if needed > self._max_bytes():
            raise MapError(
                f"{model_name(model)}: with it the map would take {needed / 1e6:.0f} MB of "
                "memory; max_map_mb allows less"
            )

    def _placed(self, region: StoredRegion) -> PlacedRegion:
        """A region ready to answer; made once, for it takes milliseconds."""
        return PlacedRegion(region, self._config.field.backend)

    def _is_wanted(self, model: RegionModel) -> bool:
        return model.map_id != self._replaced_map_id and self._catalog.is_news(model)

    def snapshot(self) -> MapSnapshot:
        """The map as it is now.

        Raises:
            MapError: when it holds no region.
        """
        with self._lock:
            if self._snapshot is None:
                regions = dict(self._regions)
                neural_map = NeuralMap(regions.values(), self._config.map)
                self._surfaces = MapSurfaces(neural_map, known=self._surfaces)
                self._snapshot = MapSnapshot(
                    map_id=self._catalog.map_id,
                    stamp_ns=self._catalog.newest_stamp_ns,
                    versions={i: region.stored.version for i, region in regions.items()},
                    map=neural_map,
                    surfaces=self._surfaces,
                )
            return self._snapshot

    def entries(self) -> list[RegionEntry]:
        """What is known of the regions, in the order of their creation."""
        with self._lock:
            return list(self._catalog.entries.values())

    def message(self, overlap: float) -> RegionArray:
        """The catalogue of regions as a message."""
        with self._lock:
            return self._catalog.message(self._map_frame, overlap)

    @property
    def map_id(self) -> str:
        """Identity of the map; empty as long as there is none."""
        with self._lock:
            return self._catalog.map_id

    def save(self, path: Path) -> int:
        """Write the map to a folder; returns the number of regions.

        Raises:
            OutputError: when the folder cannot be written.
        """
        content = self.content()
        content.write(MapStore(path))
        return len(content.data)

    def content(self) -> MapContent:
        """What a store holds of the map as it is now."""
        with self._lock:
            return MapContent(
                map_id=self._catalog.map_id,
                versions={i: entry.version for i, entry in self._catalog.entries.items()},
                data=list(self._data.values()),
                grid=self._grid() if self._regions else None,
            )

    def load(
        self,
        path: Path,
        confirm: Callable[[LoadedMap, list[RegionModel]], None] = lambda loaded, models: None,
    ) -> list[str]:
        """Replace the map by a stored one; returns one sentence for every damaged region.

        Args:
            path: of the stored map's folder.
            confirm: called with what was read and the regions' models, exactly as they are
                stored; what it raises leaves the map as it is.

        Raises:
            MapError: when the folder is no map or nothing of it can be read.
        """
        loaded = MapStore(path).load()
        models = [
            encoded_model(region, loaded.encoded[region.index], loaded.map_id, self._map_frame)
            for region in loaded.regions
        ]
        placed = [self._placed(region) for region in loaded.regions]
        confirm(loaded, models)
        self.before_replacing(loaded.map_id)
        with self._lock:
            self._begin(loaded.map_id)
            self._lattice = loaded.grid
            self._replaced_map_id = self._live_map_id if self._live_map_id != loaded.map_id else ""
            for region, model in zip(placed, models, strict=True):
                self._catalog.add(RegionEntry.of(model))
                self._regions[region.stored.index] = region
                self._data[region.stored.index] = bytes(model.data)
        return loaded.warnings

    def _begin(self, map_id: str) -> None:
        self._catalog.begin(map_id)
        self._lattice = None
        self._regions.clear()
        self._data.clear()
        self._snapshot = self._surfaces = None

    def _grid(self) -> RegionGrid:
        """A loaded map's lattice, else the one that the first region and the overlap tell."""
        if self._lattice is not None:
            return self._lattice
        region = next(iter(self._regions.values())).stored
        grid = RegionGrid(np.zeros(3), region.side_m, self._config.regions.overlap)
        origin = region.T_map_region[:3, 3] - grid.center(region.index)
        return RegionGrid(origin, region.side_m, self._config.regions.overlap)
