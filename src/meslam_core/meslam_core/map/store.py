"""Maps on disk: a folder with a manifest and one file a region, whole at every instant.

Region files are named by their content and never overwritten; a save writes the new ones, makes
them durable, replaces the manifest, and only then removes what the new manifest does not name.
So a crash at any instant leaves the previous map or the new one.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from meslam_core.errors import MapError, OutputError
from meslam_core.input_file import read_file
from meslam_core.map import codec
from meslam_core.map.files import (
    TEMPORARY_SUFFIX,
    cannot_write,
    sync_folder,
    write_atomically,
)
from meslam_core.map.lock import locked
from meslam_core.map.manifest import (
    MANIFEST,
    Manifest,
    NewerMapError,
    RegionEntry,
    is_region_file,
)
from meslam_core.map.reader import LoadedMap, read_manifest, read_map
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.grid import RegionGrid, RegionIndex

QUARANTINE = "quarantine"


class MapStore:
    """A map's folder.

    Args:
        path: of the folder, by custom `*.meslam`; it need not exist before a save.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._written: dict[tuple[RegionIndex, int, int, str], RegionEntry] = {}
        self._stored: dict[str, RegionEntry] = {}

    def save(
        self,
        regions: Iterable[StoredRegion | bytes],
        grid: RegionGrid,
        map_id: str | None = None,
        precision: str = "int8",
        nodes: Iterable[dict[str, Any]] = (),
    ) -> str:
        """Make the folder hold exactly these regions; only changed ones are written.

        Args:
            regions: all regions of the map, live snapshots or already encoded.
            grid: the lattice they lie on.
            map_id: of the map; by default that of the map already there, else a new one.
            precision: of snapshots' weights, as in `codec.encode`.
            nodes: of the pose graph, as JSON objects.

        Returns:
            The map's id.

        Raises:
            OutputError: when the folder cannot be written, holds something else, or another
                program is writing it. The previous map is then untouched.
            MapError: when a region cannot be encoded, or two have the same place.
        """
        try:
            with self._locked():
                return self._save(regions, grid, map_id, precision, tuple(nodes))
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def load(self, recover: bool = False) -> LoadedMap:
        """The map; damaged regions are left out and reported, nothing on disk is changed.

        Where the manifest is damaged the map is put together from the region files, which
        describe themselves.

        Args:
            recover: do the same where the manifest is missing (an interrupted first save).

        Raises:
            MapError: when there is no map, nothing of it can be read, or a newer program wrote it.
        """
        return read_map(self.path, recover)

    def manifest(self) -> Manifest:
        """The manifest alone; raises as `load`, also where it is damaged."""
        return Manifest.from_bytes(read_manifest(self.path), str(self.path / MANIFEST))

    @property
    def map_bytes(self) -> int:
        """Size of the map on disk: its regions and the manifest."""
        manifest = self.manifest()
        return sum(e.size for e in manifest.regions) + (self.path / MANIFEST).stat().st_size

    def _save(
        self,
        regions: Iterable[StoredRegion | bytes],
        grid: RegionGrid,
        map_id: str | None,
        precision: str,
        nodes: tuple[dict[str, Any], ...],
    ) -> str:
        previous = self._previous()
        keep = {entry.file: entry for entry in previous.regions} if previous else {}
        entries: dict[RegionIndex, RegionEntry] = {}
        for region in regions:
            entry, data = self._entry(region, precision, keep)
            if entry.index in entries:
                raise MapError(f"two regions have the place {entry.index}; a map has one each")
            entries[entry.index] = entry
            if data is not None and not self._holds(entry):
                write_atomically(self.path / entry.file, data)
        map_id = map_id or (previous.map_id if previous else uuid.uuid4().hex)
        manifest = Manifest(map_id, grid, tuple(entries.values()), nodes)
        write_atomically(self.path / MANIFEST, manifest.to_bytes())
        current = set(manifest.regions)
        self._written = {key: e for key, e in self._written.items() if e in current}
        self._stored = {entry.sha256: entry for entry in current}
        self._clean(manifest, previous)
        return map_id

    def _entry(
        self, region: StoredRegion | bytes, precision: str, keep: dict[str, RegionEntry]
    ) -> tuple[RegionEntry, bytes | None]:
        """A region's entry, and its bytes unless this store wrote the same version before."""
        if isinstance(region, bytes):
            stored = self._stored.get(hashlib.sha256(region).hexdigest())
            if stored is not None:
                return stored, region
            decoded = codec.decode(region)
            return RegionEntry.of(decoded.index, decoded.version, region), region
        key = (region.index, region.version, region.stamp_ns, precision)
        known = self._written.get(key)
        if known is not None and known.file in keep and self._holds(known):
            return known, None
        data = codec.encode(region, precision)
        entry = RegionEntry.of(region.index, region.version, data)
        self._written[key] = entry
        return entry, data

    def _holds(self, entry: RegionEntry) -> bool:
        """Whether a region's file is there with the right content."""
        try:
            data = read_file(self.path / entry.file, codec.MAX_FILE_BYTES)
        except OSError:
            return False
        return hashlib.sha256(data).hexdigest() == entry.sha256

    def _previous(self) -> Manifest | None:
        """The map already there.

        Raises:
            OutputError: when the folder holds something that is not ours to change.
        """
        try:
            return self.manifest()
        except NewerMapError as error:
            raise OutputError(f"{error}; it is not overwritten") from error
        except MapError:
            foreign = [name for name in os.listdir(self.path) if not _is_ours(name)]
            if foreign:
                raise OutputError(
                    f"{self.path} is no map and holds {foreign[0]}; choose another folder"
                ) from None
            return None

    def _clean(self, manifest: Manifest, previous: Manifest | None) -> None:
        """Remove what the new manifest does not name; damaged files go into quarantine."""
        named = {entry.file for entry in manifest.regions}
        checksums = {e.file: e for e in previous.regions} if previous else {}
        for name in sorted(os.listdir(self.path)):
            path = self.path / name
            if name in named or not _is_ours(name) or name in (MANIFEST, QUARANTINE):
                continue
            # What cannot be removed now is removed by a later save.
            with contextlib.suppress(OSError):
                if name in checksums and not self._holds(checksums[name]):
                    (self.path / QUARANTINE).mkdir(exist_ok=True)
                    os.replace(path, self.path / QUARANTINE / name)
                else:
                    os.unlink(path)
        with contextlib.suppress(OSError):
            sync_folder(self.path)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """The folder, made where it is missing, with no other writer in it."""
        created = not self.path.exists()
        with contextlib.ExitStack() as stack:
            if created:
                stack.callback(self._remove_unfinished)
                self.path.mkdir(parents=True)
                sync_folder(self.path.parent)
            stack.enter_context(locked(self.path))
            yield

    def _remove_unfinished(self) -> None:
        """Leave nothing behind of a first save that failed; does nothing where it did not."""
        with contextlib.suppress(OSError):
            if (self.path / MANIFEST).exists():
                return
            for name in os.listdir(self.path):
                if _is_ours(name):
                    os.unlink(self.path / name)
            os.rmdir(self.path)


def _is_ours(name: str) -> bool:
    base = name.removesuffix(TEMPORARY_SUFFIX)
    return base in (MANIFEST, QUARANTINE) or is_region_file(base)
