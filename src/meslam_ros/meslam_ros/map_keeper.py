"""Maps that are kept without being asked: no killed process and no new map makes one vanish."""

from __future__ import annotations

import hashlib
import re
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from meslam_core.errors import MapError, MeslamError
from meslam_core.map.manifest import MANIFEST
from meslam_core.map.store import MapStore
from meslam_core.regions.grid import RegionIndex
from meslam_ros.map_models import MapContent, MapModels
from meslam_ros.node_settings import MapServerSettings

RECENT = "recent"
MAP_ID = re.compile(r"[0-9a-f]{32}")
POLL_S = 0.2
# Writing may take this share of all time.
WRITE_SHARE = 0.03
RETRY_S = 60.0


class MapKeeper:
    """Writes the map that is served to a folder of its own, and finds it again after a crash.

    Each map lies below the folder under its map_id, as any stored map, whole at every instant. It
    is written in the background while it changes, and at once before another map replaces it.
    The oldest maps beyond the limit are removed.

    Args:
        models: the map.
        folder: for the maps.
        settings: how many, and how often.
        inform, warn: take messages for people.

    Attributes:
        failure: why the map could not be written the last time; empty when it could.
    """

    def __init__(
        self,
        models: MapModels,
        folder: Path,
        settings: MapServerSettings,
        inform: Callable[[str], object],
        warn: Callable[[str], object],
    ) -> None:
        self._models = models
        self._folder = folder
        self._settings = settings
        self._inform = inform
        self._warn = warn
        self.failure = ""
        self._kept: tuple[str, dict[RegionIndex, int]] = ("", {})
        self._store: MapStore | None = None
        self._pause_s = 0.0
        self._writing = threading.Lock()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        models.before_replacing = self._keep_replaced

    def restore(self) -> str:
        """Serve the newest map that can be read; its folder, or empty where there is none."""
        for path in self._maps():
            try:
                damaged = self._models.load(path)
            except MapError as error:
                self._warn(f"a kept map cannot be read: {error}")
                continue
            for message in damaged:
                self._warn(message)
            content = self._models.content()
            self._kept = content.map_id, content.versions
            return str(path)
        return ""

    def start(self) -> None:
        """Keep the map from now on."""
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, name="map keeper", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Keep what there is, and stop."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        self.keep()

    def keep(self) -> None:
        """Write the map now, if it has changed since it was written."""
        with self._writing:
            content = self._models.content()
            versions = content.map_id, content.versions
            if not self._settings.kept_maps or not content.data or versions == self._kept:
                return
            started = time.monotonic()
            try:
                self._write(content)
            except (MeslamError, OSError) as error:
                self.failure = f"the map is not kept below {self._folder}: {error}"
                self._warn(self.failure)
                self._pause_s = RETRY_S
                return
            self.failure = ""
            self._kept = versions
            self._pause_s = (time.monotonic() - started) / WRITE_SHARE

    def _keep_replaced(self, next_id: str) -> None:
        self.keep()
        map_id, _ = self._kept
        if map_id and map_id == self._models.map_id != next_id:
            path = self._folder / _folder_name(map_id)
            self._inform(f"another map takes the place of {map_id}, which is kept in {path}")

    def _run(self) -> None:
        written_s = time.monotonic()
        while not self._closing.wait(POLL_S):
            pause_s = max(self._pause_s, self._settings.keep_period_s)
            if time.monotonic() - written_s >= pause_s:
                self.keep()
                written_s = time.monotonic()

    def _write(self, content: MapContent) -> None:
        path = self._folder / _folder_name(content.map_id)
        if self._store is None or self._store.path != path:
            self._store = MapStore(path)
        content.write(self._store)
        others = [other for other in self._maps() if other != path]
        for oldest in others[self._settings.kept_maps - 1 :]:
            shutil.rmtree(oldest, ignore_errors=True)

    def _maps(self) -> list[Path]:
        """Folders of the kept maps, the newest first."""
        found: list[tuple[float, Path]] = []
        for manifest in self._folder.glob(f"*/{MANIFEST}"):
            try:
                if MAP_ID.fullmatch(manifest.parent.name) and not manifest.parent.is_symlink():
                    found.append((manifest.stat().st_mtime, manifest.parent))
            except OSError:
                continue
        return [path for _, path in sorted(found, reverse=True)]


def _folder_name(map_id: str) -> str:
    """A map's folder; identities come from the network and may be anything."""
    return map_id if MAP_ID.fullmatch(map_id) else hashlib.sha256(map_id.encode()).hexdigest()[:32]
