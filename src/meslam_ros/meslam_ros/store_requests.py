"""Maps to disk and back, and on request into tracking."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from meslam_core.errors import MapError
from meslam_core.map.reader import LoadedMap
from meslam_core.map.store import MapStore
from meslam_interfaces.msg import RegionModel
from meslam_interfaces.srv import LoadMap, SaveMap, UseMap
from meslam_ros.answers import Code, RequestError, exclusive
from meslam_ros.folders import make_folder, path_below
from meslam_ros.served_map import ServedMap

MODES = {
    LoadMap.Request.VIEW: "",
    LoadMap.Request.CONTINUE: "; tracking goes on in it as soon as it has prepared it",
    LoadMap.Request.LOCALISE: "; tracking finds its poses in it as soon as it has prepared it",
}


class StoreRequests:
    """Handlers of the requests that store the map and replace it by a stored one.

    Args:
        served: the map.
        use_map: asks tracking to go over to a map; raises `RequestError` when it is not there.
    """

    def __init__(
        self, served: ServedMap, use_map: Callable[[UseMap.Request], UseMap.Response]
    ) -> None:
        self._served = served
        self._models = served.models
        self._use_map = use_map
        self._storing = threading.Lock()

    def save_map(self, request: SaveMap.Request, response: SaveMap.Response) -> None:
        """Write the regions' networks to a map store."""
        map_id = self._served.snapshot().map_id
        path = self._path(request.name or map_id)
        with exclusive(self._storing, "another map is being saved or loaded"):
            stored = _stored_map_id(path)
            if stored not in (None, map_id) and not request.overwrite:
                raise RequestError(
                    Code.INVALID_REQUEST,
                    f"{path} holds another map ({stored}); choose another name or set overwrite",
                )
            make_folder(path.parent)
            response.regions = self._models.save(path)
        response.path = str(path)
        response.bytes = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        response.message = f"{response.regions} regions written to {path}"

    def load_map(self, request: LoadMap.Request, response: LoadMap.Response) -> None:
        """Replace the map by a stored one, here and on request in tracking."""
        if request.mode not in MODES:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"there is no mode {request.mode}; VIEW is 0, CONTINUE 1, LOCALISE 2",
            )
        path = self._path(request.name)
        if not path.is_dir():
            raise RequestError(Code.NOT_FOUND, f"there is no map {path}")

        def confirm(loaded: LoadedMap, models: list[RegionModel]) -> None:
            if request.mode != LoadMap.Request.VIEW:
                self._give_to_tracking(request, loaded, models)

        with exclusive(self._storing, "another map is being saved or loaded"):
            response.quarantined = self._models.load(path, confirm)
        response.path = str(path)
        response.map_id = self._models.map_id
        response.regions = len(self._models.entries())
        response.message = f"{response.regions} regions read from {path}{MODES[request.mode]}"
        if response.quarantined:
            response.message += f"; {len(response.quarantined)} were damaged and left out"

    def _give_to_tracking(
        self, request: LoadMap.Request, loaded: LoadedMap, models: list[RegionModel]
    ) -> None:
        if loaded.warnings:
            raise MapError(
                f"tracking needs the whole map: {loaded.warnings[0]}; VIEW takes the rest"
            )
        wanted = UseMap.Request(
            mode=request.mode,
            map_id=loaded.map_id,
            regions=models,
            lattice_side_m=loaded.grid.side_m,
            overlap=loaded.grid.overlap,
            use_start_pose=request.use_start_pose,
            start_pose=request.start_pose,
        )
        origin = wanted.lattice_origin
        origin.x, origin.y, origin.z = map(float, loaded.grid.origin)
        answer = self._use_map(wanted)
        if answer.result != Code.SUCCESS:
            raise RequestError(answer.result, f"tracking refuses the map: {answer.message}")

    def _path(self, name: str) -> Path:
        return path_below(self._served.settings.map_folder, name, "map_folder")


def _stored_map_id(path: Path) -> str | None:
    """Identity of the map in a folder; None where there is none."""
    try:
        return MapStore(path).manifest().map_id
    except MapError:
        return None
