"""Keeps the scene's meshes and its occupancy slice up to date with the regions' networks."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from meslam_core.errors import MapError
from meslam_core.regions.grid import RegionIndex
from meslam_core.viewer.map_process import MapProcess
from meslam_core.viewer.scene import OccupancySlice, Scene, Surface, ViewControls

logger = logging.getLogger(__name__)

POLL_S = 0.1
# A region that has not changed for so long is meshed as finely as it is wanted.
SETTLED_S = 3.0
GROWING_RESOLUTION_M = 0.06
OCCUPANCY_CELL_M = 0.05
OCCUPANCY_PERIOD_S = 0.5
MAX_FAILURES = 3


@dataclass(frozen=True)
class _Model:
    version: int
    data: bytes
    changed_s: float


class BackgroundMap:
    """Asks the map process for what is out of date, one thing at a time, in a thread of its own.

    A region that is being trained is meshed coarsely, which takes a tenth of a second, and finely
    when it has settled. Nothing is done while nobody looks.

    Args:
        scene: whose surfaces and occupancy are set.
        controls: resolution and slice that are wanted.
        watched: whether somebody looks.
    """

    def __init__(self, scene: Scene, controls: ViewControls, watched: Callable[[], bool]) -> None:
        self._scene = scene
        self._controls = controls
        self._watched = watched
        self._lock = threading.Lock()
        self._models: dict[RegionIndex, _Model] = {}
        self._map_number = 0
        self._exporting = threading.Lock()
        self._wanted: tuple[float, str, Future[bytes]] | None = None
        self._known: dict[RegionIndex, int] = {}
        self._known_map = 0
        self._sliced: tuple[object, ...] = ()
        self._sliced_s = float("-inf")
        self._stopping = threading.Event()
        # Why there is nobody any more who would make an export.
        self._over = ""
        self._process = MapProcess()
        self._thread = threading.Thread(target=self._run, name="viewer map", daemon=True)
        self._thread.start()

    @property
    def process(self) -> MapProcess:
        """That works at present."""
        return self._process

    @property
    def given_up(self) -> bool:
        """Whether nothing is made any more."""
        return bool(self._over)

    def begin(self) -> None:
        """Forget all regions; another map begins."""
        with self._lock:
            self._models = {}
            self._map_number += 1

    def take(self, index: RegionIndex, version: int, data: bytes) -> None:
        """Take a region's newest model, as it is stored and sent."""
        with self._lock:
            self._models[index] = _Model(version, data, time.monotonic())

    def export(self, resolution_m: float, suffix: str) -> bytes:
        """The mesh of the whole map as a file.

        Args:
            resolution_m: spacing of the vertices [m].
            suffix: of the file's name, one of `map.mesh_file.FORMATS`.

        Raises:
            MapError: when there is no map, it would be too large, another one is being made, or
                the viewer makes none any more.
        """
        if not self._exporting.acquire(blocking=False):
            raise MapError("another mesh is being made; try again in a moment")
        try:
            future: Future[bytes] = Future()
            with self._lock:
                if self._over:
                    raise MapError(self._over)
                self._wanted = resolution_m, suffix, future
            return future.result()
        finally:
            self._exporting.release()

    def close(self) -> None:
        """Stop; also in the middle of a mesh."""
        self._stopping.set()
        self._process.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._serve()
        finally:
            over = "the viewer is being closed"
            if not self._stopping.is_set():
                over = "the viewer makes no mesh any more; its log says why"
            with self._lock:
                self._over = over
            self._refuse_export(over)

    def _serve(self) -> None:
        failures, complaint = 0, ""
        while not self._stopping.is_set():
            try:
                if not self._step():
                    self._stopping.wait(POLL_S)
            except MapError as error:
                if str(error) != complaint:
                    complaint = str(error)
                    logger.warning("the viewer's mesh: %s", complaint)
                self._stopping.wait(SETTLED_S)
            except (EOFError, OSError):
                if self._stopping.is_set():
                    return
                failures += 1
                self._process.close()
                self._refuse_export("the process that makes the mesh has ended; try again")
                if failures > MAX_FAILURES:
                    logger.error("the process that makes the viewer's mesh ended too often")
                    return
                logger.warning("the process that makes the viewer's mesh has ended: a new one")
                self._known, self._process = {}, MapProcess()

    def _refuse_export(self, reason: str) -> None:
        with self._lock:
            wanted, self._wanted = self._wanted, None
        if wanted is not None:
            wanted[2].set_exception(MapError(reason))

    def _step(self) -> bool:
        """Do the most urgent thing; False when there is none."""
        with self._lock:
            models, map_number, wanted = dict(self._models), self._map_number, self._wanted
        if wanted is None and not self._watched():
            return False
        if map_number != self._known_map:
            self._process.ask({"do": "forget"})
            self._known, self._known_map = {}, map_number
            self._scene.surfaces.set({})
            self._scene.occupancy.set(None)
        for index, model in models.items():
            if self._known.get(index) != model.version:
                self._hand_over(index, model)
        if wanted is not None:
            self._make_export(*wanted)
        usable = {index: models[index] for index in models.keys() & self._known.keys()}
        return bool(usable) and (self._slice() or self._mesh(usable))

    def _hand_over(self, index: RegionIndex, model: _Model) -> None:
        """Give the process a region; one that it cannot use is left out until the next version."""
        try:
            self._process.ask({"do": "take", "index": index}, model.data)
        except MapError as error:
            logger.warning("the viewer leaves a region out: %s", error)
            with self._lock:
                if self._models.get(index) is model:
                    del self._models[index]
        else:
            self._known[index] = model.version

    def _make_export(self, resolution_m: float, suffix: str, future: Future[bytes]) -> None:
        request = {"do": "export", "resolution_m": resolution_m, "suffix": suffix}
        try:
            content = self._process.ask(request)[1]
        except MapError as error:
            self._refuse_export(str(error))
        else:
            # Before it is answered: the next one may be wanted at once.
            with self._lock:
                self._wanted = None
            future.set_result(content)

    def _slice(self) -> bool:
        """Renew the occupancy if it is wanted and out of date."""
        height_m, now = self._controls.occupancy_height_m, time.monotonic()
        wanted = (height_m, self._known_map, *sorted(self._known.items()))
        if not self._controls.occupancy_shown or wanted == self._sliced:
            return False
        if self._sliced[:1] == (height_m,) and now - self._sliced_s < OCCUPANCY_PERIOD_S:
            return False
        request = {"do": "layer", "height_m": height_m, "resolution_m": OCCUPANCY_CELL_M}
        answer, cells = self._process.ask(request)
        self._scene.occupancy.set(
            OccupancySlice(
                np.frombuffer(cells, np.int8).reshape(answer["shape"]),
                np.array(answer["origin"]),
                OCCUPANCY_CELL_M,
                height_m,
            )
        )
        self._sliced, self._sliced_s = wanted, now
        return True

    def _mesh(self, models: dict[RegionIndex, _Model]) -> bool:
        """Renew the region's mesh that is out of date, the one that changed last first."""
        surfaces, now = self._scene.surfaces.value, time.monotonic()
        newest = sorted(models.items(), key=lambda entry: entry[1].changed_s, reverse=True)
        for index, model in newest:
            resolution_m = self._controls.mesh_resolution_m
            # What is shown for the first time is shown soon.
            if index not in surfaces or now - model.changed_s < SETTLED_S:
                resolution_m = max(resolution_m, GROWING_RESOLUTION_M)
            known = surfaces.get(index)
            if known and (known.version, known.resolution_m) == (model.version, resolution_m):
                continue
            request = {"do": "mesh", "index": index, "resolution_m": resolution_m}
            answer, glb = self._process.ask(request)
            bounds = np.array(answer["bounds"])
            surface = Surface(glb, answer["triangles"], bounds, model.version, resolution_m)
            if self._map_number == self._known_map:
                self._scene.surfaces.set({**surfaces, index: surface})
            return True
        return False
