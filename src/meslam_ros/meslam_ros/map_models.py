"""The map server's map: the stored networks of its regions, and nothing else."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meslam_core.config import MeslamConfig
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid, RegionIndex
from meslam_interfaces.msg import RegionArray, RegionModel
from meslam_ros.region_catalog import RegionCatalog, RegionEntry
from meslam_ros.region_messages import region_model, stored_region


@dataclass(frozen=True)
class MapSnapshot:
    """The map at one instant; later changes make a new one.

    Attributes:
        map_id: of the map.
        stamp_ns: of the newest image in it [ns].
        versions: of its regions.
        map: that answers.
    """

    map_id: str
    stamp_ns: int
    versions: dict[RegionIndex, int]
    map: NeuralMap


class MapModels:
    """Takes models, checks them, and keeps the newest of each region; usable from any thread.

    Args:
        config: of the map's answers and of the lattice.
        map_frame: of the regions' poses.
    """

    def __init__(self, config: MeslamConfig, map_frame: str) -> None:
        self._catalog = RegionCatalog()
        self._config = config
        self._map_frame = map_frame
        self._lattice: RegionGrid | None = None
        self._regions: dict[RegionIndex, StoredRegion] = {}
        self._data: dict[RegionIndex, bytes] = {}
        self._live_map_id = ""
        self._replaced_map_id = ""
        self._snapshot: MapSnapshot | None = None
        self._lock = threading.RLock()

    def add(self, model: RegionModel) -> bool:
        """Take a region's model; whether it changed the map.

        A model of another map replaces the map, unless that map was itself replaced by loading
        a stored one: the loaded map stays until tracking begins a new one.

        Raises:
            MapError: when the model is damaged, of another format, or contradicts itself.
        """
        with self._lock:
            if model.map_id == self._replaced_map_id or not self._catalog.is_news(model):
                return False
            region = stored_region(model)
            self._live_map_id = model.map_id
            if model.map_id != self._catalog.map_id:
                self._begin(model.map_id)
            self._catalog.add(RegionEntry.of(model))
            self._regions[region.index] = region
            self._data[region.index] = bytes(model.data)
            self._snapshot = None
            return True

    def snapshot(self) -> MapSnapshot:
        """The map as it is now.

        Raises:
            MapError: when it holds no region.
        """
        with self._lock:
            if self._snapshot is None:
                regions = dict(self._regions)
                self._snapshot = MapSnapshot(
                    map_id=self._catalog.map_id,
                    stamp_ns=self._catalog.newest_stamp_ns,
                    versions={index: region.version for index, region in regions.items()},
                    map=NeuralMap(regions.values(), self._config.map, self._config.field.backend),
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
        """Write the map to a store; returns the number of regions.

        Raises:
            OutputError: when the folder cannot be written.
        """
        with self._lock:
            data, grid, map_id = list(self._data.values()), self._grid(), self._catalog.map_id
        MapStore(path).save(data, grid, map_id)
        return len(data)

    def load(self, path: Path) -> list[str]:
        """Replace the map by a stored one; returns one sentence for every damaged region.

        Raises:
            MapError: when the folder is no map or nothing of it can be read.
        """
        loaded = MapStore(path).load()
        precision = self._config.map.codec
        models = [
            region_model(region, loaded.map_id, self._map_frame, precision)
            for region in loaded.regions
        ]
        # Networks that were stored with this precision encode to the very same bytes again.
        with self._lock:
            self._begin(loaded.map_id)
            self._lattice = loaded.grid
            self._replaced_map_id = self._live_map_id if self._live_map_id != loaded.map_id else ""
            for region, model in zip(loaded.regions, models, strict=True):
                self._catalog.add(RegionEntry.of(model))
                self._regions[region.index] = region
                self._data[region.index] = bytes(model.data)
        return loaded.warnings

    def _begin(self, map_id: str) -> None:
        self._catalog.begin(map_id)
        self._lattice = None
        self._regions.clear()
        self._data.clear()
        self._snapshot = None

    def _grid(self) -> RegionGrid:
        """A loaded map's lattice, else the one that the first region and the overlap tell."""
        if self._lattice is not None:
            return self._lattice
        region = next(iter(self._regions.values()))
        grid = RegionGrid(np.zeros(3), region.side_m, self._config.regions.overlap)
        origin = region.T_map_region[:3, 3] - grid.center(region.index)
        return RegionGrid(origin, region.side_m, self._config.regions.overlap)
