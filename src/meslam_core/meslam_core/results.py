"""The folder that a run leaves behind: complete results, or none."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from meslam_core.errors import MapError, OutputError
from meslam_core.frame_log import FRAMES
from meslam_core.map.lock import locked
from meslam_core.map.manifest import MANIFEST, NewerMapError
from meslam_core.map.store import MapStore

TRAJECTORY = "trajectory.txt"
ONLINE_TRAJECTORY = "trajectory_online.txt"
COVARIANCES = "covariance_online.txt"
MAP = "map.meslam"
PREVIOUS_MAP = "previous.meslam"
REPORT = "report.json"
STAGING = ".incomplete"


class ResultFolder:
    """Results are written beside their place and moved there together when all are complete.

    A context manager: entering checks that the folder can be written before any work is done,
    and keeps other runs out of it; leaving removes what was not published, and the folder itself
    where it is new and empty. An earlier map is there until the new one is; where there is no new
    one it is kept as `previous.meslam`.

    Args:
        path: the folder; it and its parents are made.

    Raises:
        OutputError: on entry, when the folder cannot be made or written, another run writes it, or
            a newer version's map is there.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._staging = self.path / f"{STAGING}.{os.getpid()}"
        self._lock = contextlib.ExitStack()
        self._created: list[Path] = []

    def __enter__(self) -> ResultFolder:
        try:
            self._check_earlier_map()
            for folder in (*reversed(self.path.parents), self.path):
                if not folder.is_dir():
                    folder.mkdir()
                    self._created.append(folder)
            self._lock.enter_context(locked(self.path))
            # Whoever left these was killed, for the lock is ours.
            for abandoned in self.path.glob(f"{STAGING}.*"):
                shutil.rmtree(abandoned, ignore_errors=True)
            self._staging.mkdir()
        except OSError as error:
            self._clean()
            raise OutputError(
                f"results cannot be written to {self.path} ({error.strerror}); choose a folder "
                "that can be made and written"
            ) from error
        return self

    def _check_earlier_map(self) -> None:
        """Raise where the map's place holds what must not be replaced."""
        occupied = self.path / MAP
        if not occupied.exists():
            return
        try:
            MapStore(occupied).manifest()
        except NewerMapError as error:
            raise OutputError(f"{error}; it is not overwritten, choose another folder") from error
        except MapError as error:
            # A damaged map is replaced like any other.
            if not (occupied / MANIFEST).is_file():
                raise OutputError(
                    f"{occupied} exists and is not a map store; move it away or choose another "
                    "folder"
                ) from error

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._clean()

    def incomplete(self, name: str) -> Path:
        """Where to write a result until `publish`; made again where somebody removed it."""
        with contextlib.suppress(OSError):
            self._staging.mkdir(parents=True, exist_ok=True)
        return self._staging / name

    def write_report(self, entries: Mapping[str, Any]) -> None:
        """Write `report.json`.

        Raises:
            OutputError: when it cannot be written.
        """
        text = json.dumps(entries, indent=2, allow_nan=False) + "\n"
        try:
            self.incomplete(REPORT).write_text(text, encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"{self.path / REPORT} cannot be written ({error}); "
                "free space, or choose another folder"
            ) from error

    def publish(self) -> None:
        """Replace the results of an earlier run by the new ones.

        Raises:
            OutputError: when they cannot be moved to their places.
        """
        try:
            self._publish_map()
            for name in (TRAJECTORY, ONLINE_TRAJECTORY, COVARIANCES, FRAMES, REPORT):
                result = self.incomplete(name)
                if result.exists():
                    result.replace(self.path / name)
        except OSError as error:
            raise OutputError(
                f"results cannot be written to {self.path} ({error}); "
                "free space, or choose another folder"
            ) from error

    def _publish_map(self) -> None:
        """Replace an earlier map without an instant at which there is none."""
        target, result = self.path / MAP, self.incomplete(MAP)
        if not result.exists():
            # It does not belong to these results, but it is somebody's map.
            if target.exists():
                shutil.rmtree(self.path / PREVIOUS_MAP, ignore_errors=True)
                target.replace(self.path / PREVIOUS_MAP)
        elif not target.exists():
            result.replace(target)
        else:
            new = MapStore(result).load()
            MapStore(target).save(new.encoded.values(), new.grid, new.map_id, nodes=new.nodes)

    def _clean(self) -> None:
        shutil.rmtree(self._staging, ignore_errors=True)
        self._lock.close()
        for folder in reversed(self._created):
            if not folder.is_dir() or any(folder.iterdir()):
                break
            folder.rmdir()
