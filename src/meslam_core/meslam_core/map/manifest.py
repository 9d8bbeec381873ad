"""The manifest of a map store: what belongs to the map, with checksums."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from meslam_core.config import RegionsConfig
from meslam_core.errors import MapError
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import MAX_REGIONS, RegionGrid, RegionIndex

MANIFEST = "manifest.json"
MAP_FORMAT = "meslam-map"
MAP_VERSION = 1
MAX_MANIFEST_BYTES = 16 << 20
OFF_LATTICE = 1 << 20  # added to the third index of regions that lie on another lattice

_DIGEST = re.compile(rb'"sha256": "([0-9a-f]{64})"\n\}\n\Z')
_BLANK = b"0" * 64
_REGION_FILE = re.compile(r"region(_-?\d+){3}\.[0-9a-f]{16}\.msr")


@dataclass(frozen=True)
class RegionEntry:
    """A region file of the map: its place on the lattice, name, checksum and size."""

    index: RegionIndex
    file: str
    sha256: str
    size: int
    version: int

    @classmethod
    def of(cls, index: RegionIndex, version: int, data: bytes) -> RegionEntry:
        """The entry of encoded bytes; the name tells the content, so no file is overwritten."""
        digest = hashlib.sha256(data).hexdigest()
        place = "_".join(map(str, index))
        return cls(index, f"region_{place}.{digest[:16]}.msr", digest, len(data), version)


@dataclass(frozen=True)
class Manifest:
    """What a map consists of.

    Attributes:
        map_id: identifies the map across its versions.
        grid: the lattice of its regions.
        regions: one entry each.
        nodes: of the pose graph, as JSON objects.
    """

    map_id: str
    grid: RegionGrid
    regions: tuple[RegionEntry, ...]
    nodes: tuple[dict[str, Any], ...] = ()

    def to_bytes(self) -> bytes:
        """JSON whose last member is the checksum of the file with that checksum as zeros."""
        document = {
            "format": MAP_FORMAT,
            "version": MAP_VERSION,
            "map_id": self.map_id,
            "lattice": {
                "origin": [float(value) for value in self.grid.origin],
                "side_m": float(self.grid.side_m),
                "overlap": float(self.grid.overlap),
            },
            "regions": [_entry_to_json(entry) for entry in self.regions],
            "pose_graph": {"nodes": list(self.nodes)},
            "sha256": _BLANK.decode(),
        }
        blank = json.dumps(document, indent=1, allow_nan=False).encode() + b"\n"
        digest = hashlib.sha256(blank).hexdigest().encode()
        return digest.join(blank.rsplit(_BLANK, 1))

    @classmethod
    def from_bytes(cls, data: bytes, name: str) -> Manifest:
        """The manifest read from `name`.

        Raises:
            MapError: when it is damaged or of a newer version.
        """
        if len(data) > MAX_MANIFEST_BYTES:
            raise MapError(f"{name}: {len(data)} bytes are too many for a manifest")
        found = _DIGEST.search(data)
        blank = data if found is None else data[: found.start(1)] + _BLANK + data[found.end(1) :]
        if found is None or hashlib.sha256(blank).hexdigest().encode() != found[1]:
            raise MapError(f"{name}: the checksum does not match; the manifest is damaged")
        try:
            document = json.loads(data)
            if document["format"] != MAP_FORMAT:
                raise MapError(f"{name} is not a map's manifest but {document['format']!r}")
            if document["version"] > MAP_VERSION:
                raise NewerMapError(
                    f"{name} has format version {document['version']}, this program reads up to "
                    f"{MAP_VERSION}; use a newer MeSLAM"
                )
            return cls._parsed(document)
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise MapError(f"{name}: the manifest is malformed ({error!r})") from error

    @classmethod
    def _parsed(cls, document: dict[str, Any]) -> Manifest:
        lattice = document["lattice"]
        entries = tuple(_entry(values) for values in document["regions"])
        origin = np.array([float(value) for value in lattice["origin"]])
        side_m, overlap = float(lattice["side_m"]), float(lattice["overlap"])
        if origin.shape != (3,) or not np.isfinite([*origin, side_m, overlap]).all():
            raise ValueError("the lattice's numbers are not finite")
        if side_m <= 0.0 or not 0.0 <= overlap < 1.0 or len(entries) > MAX_REGIONS:
            raise ValueError("the lattice or the number of regions is out of range")
        if len({entry.index for entry in entries}) < len(entries):
            raise ValueError("a place on the lattice has two regions")
        return cls(
            map_id=str(document["map_id"]),
            grid=RegionGrid(origin, side_m, overlap),
            regions=entries,
            nodes=tuple(dict(node) for node in document["pose_graph"]["nodes"]),
        )


class NewerMapError(MapError):
    """A map written by a newer program; it is intact and must not be touched."""


def is_region_file(name: str) -> bool:
    """Whether a file's name is one that a store gives to a region."""
    return _REGION_FILE.fullmatch(name) is not None


def grid_of(regions: list[StoredRegion]) -> RegionGrid:
    """The lattice that regions lie on, as far as they tell it; the overlap may be a default.

    Args:
        regions: at least one, none moved off the lattice.
    """
    placed = [region for region in regions if abs(region.index[2]) < OFF_LATTICE // 2]
    first = (placed or regions)[0]
    spacing_m = first.side_m * (1.0 - RegionsConfig().overlap)
    for other in placed[1:]:
        steps = np.subtract(other.index, first.index)
        axis = int(np.abs(steps).argmax())
        if steps[axis]:
            moved = (other.T_map_region - first.T_map_region)[axis, 3]
            spacing_m = float(moved / steps[axis])
            break
    origin = first.T_map_region[:3, 3] - spacing_m * np.asarray(first.index)
    return RegionGrid(origin, first.side_m, 1.0 - spacing_m / first.side_m)


def _entry_to_json(entry: RegionEntry) -> dict[str, Any]:
    return {
        "index": list(entry.index),
        "file": entry.file,
        "sha256": entry.sha256,
        "bytes": entry.size,
        "version": entry.version,
    }


def _entry(values: dict[str, Any]) -> RegionEntry:
    index = tuple(int(value) for value in values["index"])
    name = str(values["file"])
    # A manifest must not make a reader open files elsewhere.
    if len(index) != 3 or not is_region_file(name):
        raise ValueError(f"{name!r} is not the name of a region's file")
    return RegionEntry(
        index=(index[0], index[1], index[2]),
        file=name,
        sha256=str(values["sha256"]),
        size=int(values["bytes"]),
        version=int(values["version"]),
    )
