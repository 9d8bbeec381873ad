"""What `meslam run` wrote, or a stored map alone, in the viewer."""

from __future__ import annotations

from pathlib import Path

from meslam_core.map.manifest import MANIFEST
from meslam_core.map.store import MapStore
from meslam_core.report.run_folder import read_run
from meslam_core.results import MAP
from meslam_core.viewer.replay import Replay, map_status, region_boxes, run_status
from meslam_core.viewer.viewer import Viewer


class FinishedRun:
    """Shows what `meslam run` wrote, or a stored map alone, in a viewer.

    Args:
        viewer: to show it in.
        path: of the run's folder or the map.
        recording: where the images are, instead of where the run says.

    Attributes:
        missing: a sentence for everything that cannot be shown.

    Raises:
        EvaluationError: when the folder is not a run's or a file of it is damaged.
        MapError: when nothing of the map can be read.
        RecordingError: when the given recording cannot be read.
    """

    def __init__(self, viewer: Viewer, path: Path, recording: Path | None = None) -> None:
        self._run = None if (path / MANIFEST).is_file() else read_run(path, recording=recording)
        loaded = MapStore(path if self._run is None else path / MAP).load()
        self.missing = list(loaded.warnings)
        viewer.scene.regions.set(region_boxes(loaded))
        status = map_status(loaded)
        viewer.scene.status.set(status if self._run is None else run_status(self._run, status))
        for region in loaded.regions:
            viewer.map.take(region.index, region.version, loaded.encoded[region.index])
        self._replay: Replay | None = None
        if self._run is not None and self._run.refined is not None:
            self._replay = Replay(viewer.scene, viewer.page, self._run)
        if self._run is not None and self._run.recording is None:
            self.missing += [line for line in self._run.missing if line.startswith("Camera images")]

    def close(self) -> None:
        """Release the recording."""
        if self._replay is not None:
            self._replay.close()
        if self._run is not None:
            self._run.close()
