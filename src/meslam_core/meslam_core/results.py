"""The folder that a run leaves behind: complete results, or none."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from meslam_core.errors import OutputError
from meslam_core.frame_log import FRAMES
from meslam_core.map.manifest import MANIFEST

TRAJECTORY = "trajectory.txt"
ONLINE_TRAJECTORY = "trajectory_online.txt"
COVARIANCES = "covariance_online.txt"
MAP = "map.meslam"
REPORT = "report.json"


class ResultFolder:
    """Results are written beside their place and moved there together when all are complete.

    A context manager: entering checks that the folder can be written before any work is done,
    leaving removes what was not published, and the folder itself where it is new and empty.

    Args:
        path: the folder; it and its parents are made.

    Raises:
        OutputError: on entry, when the folder cannot be made or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._staging = self.path / f".incomplete.{os.getpid()}"
        self._created: list[Path] = []

    def __enter__(self) -> ResultFolder:
        occupied = self.path / MAP
        if occupied.exists() and not (occupied / MANIFEST).is_file():
            raise OutputError(
                f"{occupied} exists and is not a map store; move it away or choose another folder"
            )
        try:
            for folder in (*reversed(self.path.parents), self.path):
                if not folder.is_dir():
                    folder.mkdir()
                    self._created.append(folder)
            self._staging.mkdir()
        except OSError as error:
            self._clean()
            raise OutputError(
                f"results cannot be written to {self.path} ({error.strerror}); choose a folder "
                "that can be made and written"
            ) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._clean()

    def incomplete(self, name: str) -> Path:
        """Where to write a result until `publish`."""
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
            raise OutputError(f"{self.path / REPORT} cannot be written ({error})") from error

    def publish(self) -> None:
        """Replace the results of an earlier run by the new ones.

        Raises:
            OutputError: when they cannot be moved to their places.
        """
        try:
            for name in (TRAJECTORY, ONLINE_TRAJECTORY, COVARIANCES, FRAMES, MAP, REPORT):
                target, result = self.path / name, self.incomplete(name)
                if target.is_dir():
                    shutil.rmtree(target)
                if result.exists():
                    result.replace(target)
        except OSError as error:
            raise OutputError(f"results cannot be written to {self.path} ({error})") from error

    def _clean(self) -> None:
        shutil.rmtree(self._staging, ignore_errors=True)
        for folder in reversed(self._created):
            if not folder.is_dir() or any(folder.iterdir()):
                break
            folder.rmdir()
