"""`map_server_node`: answers about the map, from the regions' stored networks alone."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

from meslam_core.errors import MapError
from meslam_core.se3 import Pose
from meslam_core.threads import limit_threads
from meslam_interfaces.msg import RegionModel
from meslam_interfaces.srv import (
    ExportMap,
    GetMesh,
    GetOccupancyGrid,
    ListRegions,
    LoadMap,
    QueryOccupancy,
    SaveMap,
)
from meslam_ros import topics
from meslam_ros.answers import answering
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, OK, STALE, WARN, Diagnostics, counts
from meslam_ros.export_action import ExportActionServer
from meslam_ros.managed_node import ManagedNode, run
from meslam_ros.map_keeper import RECENT, MapKeeper
from meslam_ros.map_models import MapModels
from meslam_ros.map_requests import MapRequests
from meslam_ros.map_topics import MapTopics
from meslam_ros.mesh_requests import MeshRequests
from meslam_ros.node_settings import MapFrameSettings, MapServerSettings
from meslam_ros.parameters import declare_config, declare_settings, read_config
from meslam_ros.qos import MODELS_DEPTH, latched
from meslam_ros.rgbd_input import STEADY
from meslam_ros.served_map import ServedMap
from meslam_ros.start_map import StartMap
from meslam_ros.store_requests import StoreRequests
from meslam_ros.tracking_client import TrackingClient
from meslam_ros.transform_buffer import TransformBuffer

EXECUTOR_THREADS = 8
NAMED_REFUSED = 10


class MapServerNode(ManagedNode):
    """Collects region models and serves the map; long answers do not hold up short ones."""

    def __init__(self, **options: Any) -> None:
        super().__init__("map_server_node", **options)
        self._frames = declare_settings(self, MapFrameSettings)
        self._settings = declare_settings(self, MapServerSettings)
        self._config = declare_config(self, ("regions", "map", "runtime"))

    def configure(self) -> None:
        self._config = read_config(self)
        limit_threads(self._config.runtime.threads, load_open3d=False)
        self._models = MapModels(
            self._config, self._frames.map_frame, lambda: 1e6 * self._settings.max_map_mb
        )
        log = self.get_logger()
        self._keeper = MapKeeper(
            self._models, self._kept_folder, self._settings, log.info, log.warn
        )
        self._refused: Counter[str] = Counter()
        self._transforms = TransformBuffer(self)
        served = ServedMap(self._models, self._settings, self._frames.map_frame)
        self._tracking = TrackingClient(self)
        requests = MapRequests(served, self._config.regions.overlap, self._lookup)
        meshes, stores = MeshRequests(served), StoreRequests(served, self._tracking.use_map)
        self._start_map = StartMap(self._settings, stores, self._tracking, log.info, log.error)
        self._load_first_map()
        # Of what takes long one runs at a time, so that threads are left for the rest.
        quick, mesh, grid, store, export = (
            ReentrantCallbackGroup(),
            *(MutuallyExclusiveCallbackGroup() for _ in range(4)),
        )
        self._map_services = [
            self.create_service(kind, name, answering(handler, log.error), callback_group=group)
            for kind, name, handler, group in (
                (ExportMap, topics.EXPORT_MAP, meshes.export_map, export),
                (GetMesh, topics.GET_MESH, meshes.get_mesh, mesh),
                (QueryOccupancy, topics.QUERY_OCCUPANCY, requests.query_occupancy, quick),
                (GetOccupancyGrid, topics.GET_OCCUPANCY_GRID, requests.get_occupancy_grid, grid),
                (SaveMap, topics.SAVE_MAP, stores.save_map, store),
                (LoadMap, topics.LOAD_MAP, stores.load_map, store),
                (ListRegions, topics.LIST_REGIONS, requests.list_regions, quick),
            )
        ]
        self._export = ExportActionServer(self, meshes, log.error)
        self._diagnostics = Diagnostics(self)

    def _load_first_map(self) -> None:
        """Serve the map that the parameters ask for, else the one that was kept last."""
        if self._start_map.load() or not self._settings.restore:
            return
        if restored := self._keeper.restore():
            self.get_logger().info(f"serving the map kept in {restored} until another one comes")

    @property
    def _kept_folder(self) -> Path:
        """Another one for each namespace: systems side by side do not mix their maps."""
        folder = Path(self._settings.map_folder).expanduser() / RECENT
        return folder / self.get_namespace().strip("/")

    def activate(self) -> None:
        self._keeper.start()
        self._start_map.start()
        self._subscription = self.create_subscription(
            RegionModel,
            topics.REGION_MODELS,
            self._take_model,
            latched(MODELS_DEPTH),
            callback_group=MutuallyExclusiveCallbackGroup(),
        )
        self._topics = MapTopics(self, self._models, self._settings, self._frames.map_frame)
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY)

    def deactivate(self) -> None:
        self.destroy_timer(self._timer)
        self._topics.close()
        self.destroy_subscription(self._subscription)
        self._start_map.close()
        self._keeper.close()

    def cleanup(self) -> None:
        self._diagnostics.close()
        self._transforms.close()
        self._export.close()
        self._tracking.close()
        for service in self._map_services:
            self.destroy_service(service)

    def _take_model(self, model: RegionModel) -> None:
        try:
            self._models.add(model)
        except MapError as error:
            self._count_refused(model)
            self.get_logger().error(f"region model refused: {error}")

    def _count_refused(self, model: RegionModel) -> None:
        """By place; whoever sends any number of places is counted, and costs no memory."""
        place = f"region {list(map(int, model.index))}"
        known = place in self._refused or len(self._refused) < NAMED_REFUSED
        self._refused[place if known else "other regions"] += 1

    def _lookup(self, frame: str, stamp_ns: int) -> Pose:
        """T_map_frame (4, 4) [m] at a time [ns]."""
        return self._transforms.lookup(self._frames.map_frame, frame, stamp_ns)

    def _diagnose(self) -> None:
        entries, refused = self._models.entries(), counts(self._refused)
        level, message = (OK, f"{len(entries)} regions") if entries else (STALE, "no region yet")
        if refused:
            level, message = WARN, f"region models refused: {refused}"
        if self._keeper.failure:
            level, message = WARN, self._keeper.failure
        self._diagnostics.report(
            level,
            message,
            {
                "regions": len(entries),
                "map_bytes": sum(entry.size for entry in entries),
                "refused": refused or "none",
                "kept": self._keeper.failure or "yes",
            },
        )


def main() -> None:
    """Entry point."""
    sys.exit(run(MapServerNode, EXECUTOR_THREADS))


if __name__ == "__main__":
    main()
