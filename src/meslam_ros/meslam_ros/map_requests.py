"""Questions about the map: occupancy at points and as a grid, the catalogue of regions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from numpy.typing import NDArray
from std_msgs.msg import Header

from meslam_core.errors import FrameError
from meslam_core.map.neural_map import UNKNOWN
from meslam_core.map.occupancy import OccupancyGrid, occupancy_grid
from meslam_core.se3 import Pose
from meslam_interfaces.srv import GetOccupancyGrid, ListRegions, QueryOccupancy
from meslam_ros.answers import Code, RequestError
from meslam_ros.conversions import NANOSECONDS, numbers
from meslam_ros.served_map import ServedMap, requested_box

MAX_DISTANCE_M = 100.0


class MapRequests:
    """Handlers of the questions about the map.

    Args:
        served: the map.
        overlap: of the regions, for their catalogue.
        lookup: T_map_frame (4, 4) of a frame at a time [ns]; raises `FrameError`.
    """

    def __init__(
        self, served: ServedMap, overlap: float, lookup: Callable[[str, int], Pose]
    ) -> None:
        self._served = served
        self._overlap = overlap
        self._lookup = lookup

    def query_occupancy(
        self, request: QueryOccupancy.Request, response: QueryOccupancy.Response
    ) -> None:
        """Occupancy, and on request colour and distance, at points."""
        points = self._points(request)
        farthest_m = _farthest(request)
        snapshot = self._served.snapshot()
        neural_map = snapshot.map
        state, probability = neural_map.occupancy(points)
        probability[state == UNKNOWN] = np.nan
        response.occupancy = numbers("b", state)
        response.probability = numbers("f", probability)
        if request.with_color:
            colors = np.nan_to_num(neural_map.color(points)) * 255.0 + 0.5
            response.colors = numbers("B", colors.clip(0, 255).astype(np.uint8))
        if request.with_distance:
            distances = snapshot.surfaces.signed_distance_m(points, farthest_m)
            response.distances_m = numbers("f", distances)
        known = int(np.count_nonzero(state != UNKNOWN))
        response.message = f"{known} of {len(points)} points have been observed"

    def get_occupancy_grid(
        self, request: GetOccupancyGrid.Request, response: GetOccupancyGrid.Response
    ) -> None:
        """A layer of the map as nav_msgs/OccupancyGrid."""
        settings = self._served.settings
        resolution_m = self._served.resolution(request.resolution_m, settings.grid_resolution_m)
        low, high = settings.grid_min_height_m, settings.grid_max_height_m
        if request.use_heights:
            low, high = request.min_height_m, request.max_height_m
            if not np.isfinite([low, high]).all() or low > high:
                raise RequestError(
                    Code.INVALID_REQUEST,
                    f"heights {low} to {high} m are no layer; give finite numbers, lowest first",
                )
        snapshot = self._served.snapshot()
        box = requested_box(request, "xy")
        corners = snapshot.map.bounds[:, :2] if box is None else np.array(box)
        with np.errstate(over="ignore"):
            cells = np.prod(np.ptp(corners, axis=0) / resolution_m)
            self._served.limit_cells(float(cells * max((high - low) / resolution_m, 1.0)))
        grid = occupancy_grid(snapshot.map, low, high, resolution_m, box=box)
        response.grid = grid_message(grid, self._served.header(snapshot))
        info = response.grid.info
        response.message = f"{info.width} x {info.height} cells of {resolution_m:g} m"

    def list_regions(self, _: ListRegions.Request, response: ListRegions.Response) -> None:
        """The catalogue of regions; an empty map has an empty one."""
        response.regions = self._served.models.message(self._overlap)
        response.message = f"{len(response.regions.regions)} regions"

    def _points(self, request: QueryOccupancy.Request) -> NDArray[np.float64]:
        """The request's points (N, 3) in the map frame [m]."""
        values = np.frombuffer(request.points, np.float32).astype(np.float64)
        if not len(values) or len(values) % 3:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"{len(values)} coordinates are no points; give x, y, z of each",
            )
        points = values.reshape(-1, 3)
        limit = self._served.settings.max_points
        if len(points) > limit:
            raise RequestError(
                Code.TOO_LARGE,
                f"{len(points)} points exceed the limit max_points = {limit}; ask in parts",
            )
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise RequestError(
                Code.INVALID_REQUEST, f"point {bad[0]} is {points[bad[0]]}, which is not finite"
            )
        frame = request.header.frame_id.lstrip("/")
        if frame in ("", self._served.map_frame):
            return points
        stamp = request.header.stamp
        try:
            T_map_frame = self._lookup(frame, stamp.sec * NANOSECONDS + stamp.nanosec)
        except FrameError as error:
            raise RequestError(Code.NOT_FOUND, str(error)) from error
        return points @ T_map_frame[:3, :3].T + T_map_frame[:3, 3]


def grid_message(grid: OccupancyGrid, header: Header) -> OccupancyGridMessage:
    """An occupancy grid as nav2 takes it."""
    message = OccupancyGridMessage(header=header)
    message.info.map_load_time = header.stamp
    message.info.resolution = grid.resolution_m
    message.info.height, message.info.width = grid.cells.shape
    message.info.origin.position.x, message.info.origin.position.y = map(float, grid.origin)
    message.data = numbers("b", grid.cells)
    return message


def _farthest(request: QueryOccupancy.Request) -> float:
    """Where distances are clipped [m]; 0 for the map's truncation."""
    farthest_m = float(request.max_distance_m)
    if not 0.0 <= farthest_m <= MAX_DISTANCE_M:
        raise RequestError(
            Code.INVALID_REQUEST,
            f"a largest distance of {farthest_m:g} m is outside 0 to {MAX_DISTANCE_M:g} m",
        )
    return farthest_m
