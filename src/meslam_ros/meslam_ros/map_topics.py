"""The map as topics for viewers and planners, renewed in the background while somebody listens."""

from __future__ import annotations

import threading
import time
import traceback

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from meslam_core.errors import MapError
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.occupancy import OccupancyLayer
from meslam_core.regions.grid import RegionIndex
from meslam_ros import topics
from meslam_ros.conversions import to_stamp
from meslam_ros.map_models import MapModels, MapSnapshot
from meslam_ros.map_requests import grid_message
from meslam_ros.markers import delete_all, mesh_marker, point_cloud
from meslam_ros.node_settings import MapServerSettings
from meslam_ros.qos import latched

POLL_S = 0.2
# Making the topics may take this share of the time of one core.
WORK_SHARE = 0.25


class MapTopics:
    """Publishes mesh, points and occupancy grid from the stored networks.

    What nobody subscribes to is not computed. Meshes are latched region by region: each has a
    publisher of its own that keeps the latest for late subscribers.

    Args:
        node: that publishes.
        models: the map.
        settings: resolutions, and how often.
        map_frame: of everything published.
    """

    def __init__(
        self, node: Node, models: MapModels, settings: MapServerSettings, map_frame: str
    ) -> None:
        self._node = node
        self._models = models
        self._settings = settings
        self._map_frame = map_frame
        # Keeps the topic visible, and its subscribers countable, before there is a region.
        self._clear = node.create_publisher(Marker, topics.MESH, latched())
        self._points = node.create_publisher(PointCloud2, topics.MAP_POINTS, latched())
        self._grid = node.create_publisher(OccupancyGrid, topics.OCCUPANCY_GRID, latched())
        self._meshes: dict[RegionIndex, Publisher] = {}
        self._published: dict[str, object] = {}
        self._mesh_versions: dict[RegionIndex, tuple[int, float]] = {}
        self._map_id = ""
        self._layer: tuple[tuple[float, float, float], OccupancyLayer] | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map topics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop publishing."""
        self._stopping.set()
        self._thread.join()
        for publisher in (self._clear, self._points, self._grid, *self._meshes.values()):
            self._node.destroy_publisher(publisher)

    def _run(self) -> None:
        pause_s = POLL_S
        while not self._stopping.wait(pause_s):
            started = time.monotonic()
            try:
                self._renew()
            except MapError as error:
                self._node.get_logger().error(str(error), throttle_duration_sec=10.0)
            except Exception:
                self._node.get_logger().fatal(traceback.format_exc())
            pause_s = max(POLL_S, (time.monotonic() - started) * (1.0 / WORK_SHARE - 1.0))

    def _renew(self) -> None:
        """Publish the first thing that is out of date and may be renewed."""
        wanted = [p for p in (self._clear, self._points, self._grid) if p.get_subscription_count()]
        if not wanted or not self._models.entries():
            return
        snapshot = self._models.snapshot()
        if snapshot.map_id != self._map_id:
            self._begin(snapshot)
        header = Header(stamp=to_stamp(snapshot.stamp_ns), frame_id=self._map_frame)
        if self._clear in wanted:
            self._renew_meshes(snapshot, header)
        if self._points in wanted and self._due("points", snapshot):
            points = snapshot.surfaces.points(self._settings.points_topic_spacing_m)
            self._points.publish(point_cloud(points, header))
        if self._grid in wanted and self._due("grid", snapshot):
            grid = self._current_layer().update(snapshot.map)
            self._grid.publish(grid_message(grid, header))

    def _current_layer(self) -> OccupancyLayer:
        """The grid's layer; another one when its parameters have changed."""
        settings = self._settings
        numbers = (
            settings.grid_min_height_m,
            settings.grid_max_height_m,
            settings.grid_resolution_m,
        )
        if self._layer is None or self._layer[0] != numbers:
            self._layer = numbers, OccupancyLayer(*numbers)
        return self._layer[1]

    def _begin(self, snapshot: MapSnapshot) -> None:
        """Another map: viewers forget the meshes of the one before."""
        self._map_id = snapshot.map_id
        for publisher in self._meshes.values():
            self._node.destroy_publisher(publisher)
        self._meshes.clear()
        self._mesh_versions.clear()
        self._published.clear()
        self._layer = None
        header = Header(stamp=to_stamp(snapshot.stamp_ns), frame_id=self._map_frame)
        self._clear.publish(delete_all(header))

    def _renew_meshes(self, snapshot: MapSnapshot, header: Header) -> None:
        period_s = self._settings.mesh_topic_period_s
        for index, version in snapshot.versions.items():
            known, made_s = self._mesh_versions.get(index, (-1, float("-inf")))
            now = time.monotonic()
            if period_s == 0 or version == known or now - made_s < period_s:
                continue
            mesh = extract_mesh(
                snapshot.map, self._settings.mesh_topic_resolution_m, regions=[index]
            )
            if index not in self._meshes:
                self._meshes[index] = self._node.create_publisher(Marker, topics.MESH, latched())
            number = list(self._meshes).index(index)
            self._meshes[index].publish(mesh_marker(mesh, number, header))
            self._mesh_versions[index] = version, time.monotonic()
            if self._stopping.is_set():
                return

    def _due(self, name: str, snapshot: MapSnapshot) -> bool:
        """Whether a topic is out of date and its period over; it is then taken as renewed."""
        now = time.monotonic()
        known, made_s = self._published.get(name, (None, float("-inf")))
        if known == snapshot.versions or now - made_s < self._settings.mesh_topic_period_s:
            return False
        self._published[name] = snapshot.versions, now
        return True
