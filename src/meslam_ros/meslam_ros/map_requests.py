"""The map server's answers: requests checked and bounded, results with a code and a message."""

from __future__ import annotations

import array
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from numpy.typing import NDArray
from std_msgs.msg import Header

from meslam_core.errors import FrameError, MapError, OutputError
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import FORMATS, write_mesh
from meslam_core.map.neural_map import UNKNOWN, NeuralMap
from meslam_core.map.occupancy import OccupancyGrid, occupancy_grid
from meslam_core.map.store import MapStore
from meslam_core.map.triangle_mesh import TriangleMesh
from meslam_core.regions.grid import RegionIndex
from meslam_core.se3 import Pose
from meslam_interfaces.srv import (
    ExportMap,
    GetMesh,
    GetOccupancyGrid,
    ListRegions,
    LoadMap,
    QueryOccupancy,
    SaveMap,
)
from meslam_ros.conversions import to_stamp
from meslam_ros.map_models import MapModels, MapSnapshot
from meslam_ros.node_settings import MapServerSettings
from meslam_ros.region_catalog import region_index

Code = ExportMap.Response
NAME_LIMIT = 255


class RequestError(Exception):
    """A request that is refused, with the code of the answer."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class MapRequests:
    """Handlers of the map services; every one returns its response, whatever happens.

    Args:
        models: the map.
        settings: folders and limits.
        overlap: of the regions, for their catalogue.
        map_frame: of everything in the answers.
        lookup: T_map_frame (4, 4) of a frame at a time [ns]; raises `FrameError`.
        log: takes the details of defects.
    """

    def __init__(
        self,
        models: MapModels,
        settings: MapServerSettings,
        overlap: float,
        map_frame: str,
        lookup: Callable[[str, int], Pose],
        log: Callable[[str], object],
    ) -> None:
        self._models = models
        self._settings = settings
        self._overlap = overlap
        self._map_frame = map_frame
        self._lookup = lookup
        self._log = log
        self._exporting = threading.Lock()
        self._storing = threading.Lock()

    def answer(self, handler: Callable[[Any, Any], None]) -> Callable[[Any, Any], Any]:
        """A service callback that turns a handler's errors into result codes."""

        def callback(request: Any, response: Any) -> Any:
            try:
                response.result, response.message = Code.SUCCESS, "done"
                handler(request, response)
            except RequestError as error:
                response.result, response.message = error.code, str(error)
            except OutputError as error:
                response.result, response.message = Code.IO_ERROR, str(error)
            except MapError as error:
                response.result, response.message = Code.INVALID_DATA, str(error)
            except Exception:
                self._log(traceback.format_exc())
                response.result = Code.INTERNAL_ERROR
                response.message = "this is a defect of the map server; its log has the details"
            return response

        return callback

    def export_map(self, request: ExportMap.Request, response: ExportMap.Response) -> None:
        """Write the mesh to a file below the export folder."""
        path = self._below(self._settings.export_folder, request.path, "export_folder")
        if path.suffix.lower() not in FORMATS:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"{request.path!r} does not end in {', '.join(FORMATS)}; the ending chooses the "
                "format",
            )
        with _exclusive(self._exporting, "another export is running"):
            mesh = self._mesh(request)
            _make_folder(path.parent)
            write_mesh(mesh, path)
        response.path = str(path)
        response.vertices, response.triangles = len(mesh.vertices), len(mesh.triangles)
        response.bytes = path.stat().st_size
        response.message = f"{len(mesh.triangles)} triangles written to {path}"

    def get_mesh(self, request: GetMesh.Request, response: GetMesh.Response) -> None:
        """The mesh in the answer itself."""
        snapshot = self._snapshot()
        mesh = self._mesh(request)
        response.header = self._header(snapshot)
        response.vertices = _array("f", mesh.vertices)
        response.colors = _array("B", mesh.colors)
        response.triangles = _array("I", mesh.triangles)
        response.message = f"{len(mesh.triangles)} triangles"

    def query_occupancy(
        self, request: QueryOccupancy.Request, response: QueryOccupancy.Response
    ) -> None:
        """Occupancy, and on request colour and distance, at points."""
        points = self._points(request)
        neural_map = self._snapshot().map
        state, probability = neural_map.occupancy(points)
        probability[state == UNKNOWN] = np.nan
        response.occupancy = _array("b", state)
        response.probability = _array("f", probability)
        if request.with_color or request.with_distance:
            values = neural_map.values(points)
            if request.with_color:
                colors = np.nan_to_num(values.color) * 255.0 + 0.5
                response.colors = _array("B", colors.clip(0, 255).astype(np.uint8))
            if request.with_distance:
                # The field's distance grows behind the surface, the answer's in free space.
                limit = np.float32(neural_map.truncation_m)
                distances = -neural_map.to_meters(values.distance)
                response.distances_m = _array("f", distances.clip(-limit, limit))
        known = int(np.count_nonzero(state != UNKNOWN))
        response.message = f"{known} of {len(points)} points have been observed"

    def get_occupancy_grid(
        self, request: GetOccupancyGrid.Request, response: GetOccupancyGrid.Response
    ) -> None:
        """A layer of the map as nav_msgs/OccupancyGrid."""
        resolution_m = self._resolution(request.resolution_m, self._settings.grid_resolution_m)
        low, high = self._settings.grid_min_height_m, self._settings.grid_max_height_m
        if request.use_heights:
            low, high = request.min_height_m, request.max_height_m
            if not np.isfinite([low, high]).all() or low > high:
                raise RequestError(
                    Code.INVALID_REQUEST,
                    f"heights {low} to {high} m are no layer; give finite numbers, lowest first",
                )
        snapshot = self._snapshot()
        response.grid = grid_message(
            self._grid(snapshot.map, low, high, resolution_m), self._header(snapshot)
        )
        info = response.grid.info
        response.message = f"{info.width} x {info.height} cells of {resolution_m:g} m"

    def save_map(self, request: SaveMap.Request, response: SaveMap.Response) -> None:
        """Write the regions' networks to a map store."""
        map_id = self._snapshot().map_id
        path = self._below(self._settings.map_folder, request.name or map_id, "map_folder")
        with _exclusive(self._storing, "another map is being saved or loaded"):
            stored = _stored_map_id(path)
            if stored not in (None, map_id) and not request.overwrite:
                raise RequestError(
                    Code.INVALID_REQUEST,
                    f"{path} holds another map ({stored}); choose another name or set overwrite",
                )
            _make_folder(path.parent)
            response.regions = self._models.save(path)
        response.path = str(path)
        response.bytes = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        response.message = f"{response.regions} regions written to {path}"

    def load_map(self, request: LoadMap.Request, response: LoadMap.Response) -> None:
        """Replace the map by a stored one."""
        path = self._below(self._settings.map_folder, request.name, "map_folder")
        if not path.is_dir():
            raise RequestError(Code.NOT_FOUND, f"there is no map {path}")
        with _exclusive(self._storing, "another map is being saved or loaded"):
            response.quarantined = self._models.load(path)
        response.path = str(path)
        response.map_id = self._models.map_id
        response.regions = len(self._models.entries())
        response.message = f"{response.regions} regions read from {path}"
        if response.quarantined:
            response.message += f"; {len(response.quarantined)} were damaged and left out"

    def list_regions(self, _: ListRegions.Request, response: ListRegions.Response) -> None:
        """The catalogue of regions; an empty map has an empty one."""
        response.regions = self._models.message(self._overlap)
        response.message = f"{len(response.regions.regions)} regions"

    def _snapshot(self) -> MapSnapshot:
        if not self._models.entries():
            raise RequestError(Code.EMPTY_MAP, "the map holds nothing yet")
        return self._models.snapshot()

    def _header(self, snapshot: MapSnapshot) -> Header:
        return Header(stamp=to_stamp(snapshot.stamp_ns), frame_id=self._map_frame)

    def _mesh(self, request: ExportMap.Request | GetMesh.Request) -> TriangleMesh:
        """The mesh that a request asks for, unless it is too large."""
        neural_map = self._snapshot().map
        default_m = neural_map.config.mesh_resolution_m
        resolution_m = self._resolution(request.resolution_m, default_m)
        regions = self._chosen(neural_map, request.regions)
        box = _box(request) if request.use_box else None
        self._bound(neural_map, regions, box, resolution_m)
        mesh = extract_mesh(neural_map, resolution_m, box=box, regions=regions)
        if not len(mesh.triangles):
            raise RequestError(Code.EMPTY_MAP, "no surface has been observed where you ask")
        return mesh

    def _chosen(self, neural_map: NeuralMap, requested: Iterable[Any]) -> list[RegionIndex] | None:
        indices = [region_index(entry.index) for entry in requested]
        known = {region.stored.index for region in neural_map.regions}
        missing = [index for index in indices if index not in known]
        if missing:
            raise RequestError(
                Code.NOT_FOUND, f"there is no region {missing[0]}; the map has {sorted(known)}"
            )
        return indices or None

    def _bound(
        self,
        neural_map: NeuralMap,
        regions: list[RegionIndex] | None,
        box: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
        resolution_m: float,
    ) -> None:
        """Refuse meshes over more cells than the limit."""
        chosen = neural_map.regions if regions is None else neural_map.subset(regions)
        volume_m3 = 0.0
        for region in chosen:
            centers = region.observed_centers(near_surface=True)
            if box is not None:
                centers = centers[((centers >= box[0]) & (centers <= box[1])).all(axis=1)]
            volume_m3 += len(centers) * region.stored.mask.voxel_m**3
        self._limit_cells(volume_m3 / resolution_m**3)

    def _limit_cells(self, cells: float) -> None:
        if cells > self._settings.max_cells:
            raise RequestError(
                Code.TOO_LARGE,
                f"{cells:.2g} cells exceed the limit max_cells = {self._settings.max_cells:.2g}; "
                "ask for a coarser resolution or a smaller part",
            )

    def _resolution(self, requested_m: float, default_m: float) -> float:
        if requested_m == 0.0:
            return default_m
        low, high = self._settings.min_resolution_m, self._settings.max_resolution_m
        # The request has single precision: 0.005 comes as 0.004999999888.
        resolution_m = round(float(requested_m), 6) if np.isfinite(requested_m) else requested_m
        if not low <= resolution_m <= high:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"a resolution of {requested_m:g} m is outside {low:g} to {high:g} m; 0 takes "
                f"the default of {default_m:g} m",
            )
        return resolution_m

    def _grid(
        self, neural_map: NeuralMap, low: float, high: float, resolution_m: float
    ) -> OccupancyGrid:
        extent = np.ptp(neural_map.bounds[:, :2], axis=0)
        self._limit_cells(
            float(np.prod(extent / resolution_m)) * max((high - low) / resolution_m, 1.0)
        )
        return occupancy_grid(neural_map, low, high, resolution_m)

    def _points(self, request: QueryOccupancy.Request) -> NDArray[np.float64]:
        """The request's points (N, 3) in the map frame [m]."""
        values = np.frombuffer(request.points, np.float32).astype(np.float64)
        if not len(values) or len(values) % 3:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"{len(values)} coordinates are no points; give x, y, z of each",
            )
        points = values.reshape(-1, 3)
        if len(points) > self._settings.max_points:
            raise RequestError(
                Code.TOO_LARGE,
                f"{len(points)} points exceed the limit max_points = "
                f"{self._settings.max_points}; ask in parts",
            )
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise RequestError(
                Code.INVALID_REQUEST, f"point {bad[0]} is {points[bad[0]]}, which is not finite"
            )
        frame = request.header.frame_id.lstrip("/")
        if frame in ("", self._map_frame):
            return points
        stamp = request.header.stamp
        try:
            T_map_frame = self._lookup(frame, stamp.sec * 1_000_000_000 + stamp.nanosec)
        except FrameError as error:
            raise RequestError(Code.NOT_FOUND, str(error)) from error
        return points @ T_map_frame[:3, :3].T + T_map_frame[:3, 3]

    def _below(self, folder: str, name: str, parameter: str) -> Path:
        """A path below a folder, for names that could not lead elsewhere."""
        root = Path(folder).expanduser().resolve()
        usable = bool(name) and len(name) <= NAME_LIMIT and "\0" not in name
        parts = Path(name).parts if usable else ()
        if not parts or Path(name).is_absolute() or ".." in parts:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"{name!r} is not a name below the folder {root}; give one without a leading "
                f"'/' and without '..' (the parameter {parameter} chooses the folder)",
            )
        path = (root / name).resolve()
        if root not in path.parents:
            raise RequestError(Code.INVALID_REQUEST, f"{name!r} leads out of the folder {root}")
        return path


def grid_message(grid: OccupancyGrid, header: Header) -> OccupancyGridMessage:
    """An occupancy grid as nav2 takes it."""
    message = OccupancyGridMessage(header=header)
    message.info.map_load_time = header.stamp
    message.info.resolution = grid.resolution_m
    message.info.height, message.info.width = grid.cells.shape
    message.info.origin.position.x, message.info.origin.position.y = map(float, grid.origin)
    message.data = _array("b", grid.cells)
    return message


def _array(code: str, values: NDArray[Any]) -> array.array[Any]:
    """Numbers as the type that rclpy takes without looking at each of them."""
    result: array.array[Any] = array.array(code)
    dtype = np.dtype(code)
    result.frombytes(np.ascontiguousarray(values, dtype).tobytes())
    return result


def _box(
    request: ExportMap.Request | GetMesh.Request,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low = np.array([request.box_min.x, request.box_min.y, request.box_min.z])
    high = np.array([request.box_max.x, request.box_max.y, request.box_max.z])
    if not np.isfinite([low, high]).all() or not (low < high).all():
        raise RequestError(
            Code.INVALID_REQUEST,
            f"the box from {low} to {high} is empty; give finite corners, the lowest first",
        )
    return low, high


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {path} cannot be made: {error.strerror}") from error


def _stored_map_id(path: Path) -> str | None:
    """Identity of the map in a folder; None where there is none."""
    try:
        return MapStore(path).manifest().map_id
    except MapError:
        return None


@contextmanager
def _exclusive(lock: threading.Lock, message: str) -> Iterator[None]:
    """Holds a lock, or refuses the request when somebody else does."""
    if not lock.acquire(blocking=False):
        raise RequestError(Code.BUSY, f"{message}; ask again later")
    try:
        yield
    finally:
        lock.release()
