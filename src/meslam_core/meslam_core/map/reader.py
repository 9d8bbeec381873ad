"""Reading a map's folder: what is intact is loaded, what is damaged is reported."""

from __future__ import annotations

import hashlib
import os
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meslam_core.errors import MapError
from meslam_core.input_file import read_file
from meslam_core.map import codec
from meslam_core.map.manifest import (
    MANIFEST,
    MAX_MANIFEST_BYTES,
    Manifest,
    NewerMapError,
    RegionEntry,
    grid_of,
    is_region_file,
)
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid, RegionIndex

READ_ATTEMPTS = 3


@dataclass(frozen=True)
class LoadedMap:
    """A map read from a store.

    Attributes:
        map_id: identifies the map.
        grid: the lattice of its regions.
        regions: those that are intact.
        encoded: their bytes as they are stored, by index.
        nodes: of the pose graph.
        warnings: one sentence for every damage found; empty for an intact map.
    """

    map_id: str
    grid: RegionGrid
    regions: list[StoredRegion]
    encoded: dict[RegionIndex, bytes] = field(default_factory=dict)
    nodes: tuple[dict[str, Any], ...] = ()
    warnings: list[str] = field(default_factory=list)


def read_map(path: Path, recover: bool = False) -> LoadedMap:
    """The map in a folder; see `MapStore.load`."""
    for _ in range(READ_ATTEMPTS):
        data = _manifest_or_nothing(path) if recover else read_manifest(path)
        loaded, vanished = _load(path, data)
        # A writer may have replaced the map between reading its manifest and its files.
        if not vanished or read_manifest(path) == data:
            break
    if not loaded.regions and loaded.warnings:
        raise MapError(f"{path}: no region can be read: {loaded.warnings[0]}; restore a copy")
    return loaded


def read_manifest(path: Path) -> bytes:
    """The bytes of a folder's manifest.

    Raises:
        MapError: when it is not there or cannot be read.
    """
    try:
        return read_file(path / MANIFEST, MAX_MANIFEST_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        if not path.is_dir():
            raise MapError(
                f"{path} does not exist or is no folder of a map; "
                "`meslam run RECORDING --out DIR` makes DIR/map.meslam"
            ) from None
        raise MapError(
            f"{path} holds no {MANIFEST}: it is no map, or its first save was interrupted; what "
            "was written can be loaded with recovery"
        ) from None
    except OSError as error:
        raise MapError(
            f"{path / MANIFEST} cannot be read: {error.strerror}; are its permissions right?"
        ) from error


def _manifest_or_nothing(path: Path) -> bytes:
    if path.is_dir() and not (path / MANIFEST).exists():
        return b""
    return read_manifest(path)


def _load(path: Path, data: bytes) -> tuple[LoadedMap, bool]:
    """The map of a manifest, and whether a file it names was not there."""
    try:
        manifest = Manifest.from_bytes(data, str(path / MANIFEST))
    except NewerMapError:
        raise
    except MapError as error:
        return _rebuilt(path, str(error)), False
    loaded = LoadedMap(manifest.map_id, manifest.grid, [], nodes=manifest.nodes)
    vanished = False
    for entry in manifest.regions:
        try:
            region, data = _read_region(path / entry.file, entry)
        except FileNotFoundError:
            vanished = True
            loaded.warnings.append(f"{path / entry.file} is missing; region left out")
        except (MapError, OSError) as error:
            loaded.warnings.append(f"region {entry.index} left out: {error}")
        else:
            loaded.regions.append(region)
            loaded.encoded[region.index] = data
    return loaded, vanished


def _read_region(path: Path, entry: RegionEntry) -> tuple[StoredRegion, bytes]:
    data = _read_limited(path)
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise MapError(f"{path}: the checksum does not match the manifest; it is damaged")
    region = codec.decode(data, str(path))
    if region.index != entry.index:
        raise MapError(f"{path} holds region {region.index} instead of {entry.index}")
    return region, data


def _rebuilt(path: Path, reason: str) -> LoadedMap:
    """The map as far as its region files tell it: the newest intact one of each place."""
    newest: dict[RegionIndex, StoredRegion] = {}
    encoded: dict[RegionIndex, bytes] = {}
    warnings = [f"{reason}; the map is put together from its region files"]
    for name in sorted(filter(is_region_file, os.listdir(path))):
        try:
            data = _read_limited(path / name)
            region = codec.decode(data, str(path / name))
        except (MapError, OSError) as error:
            warnings.append(f"left out: {error}")
            continue
        other = newest.get(region.index)
        if other is None or (region.stamp_ns, region.version) > (other.stamp_ns, other.version):
            newest[region.index] = region
            encoded[region.index] = data
    if not newest:
        raise MapError(
            f"{reason}; there is no intact region file to rebuild the map from; restore a copy"
        )
    regions = [newest[index] for index in sorted(newest)]
    return LoadedMap(uuid.uuid4().hex, grid_of(regions), regions, encoded, warnings=warnings)


def _read_limited(path: Path) -> bytes:
    """A region file's bytes; OSError when they are more than a region may have."""
    return read_file(path, codec.MAX_FILE_BYTES)
