"""`region_manager_node`: which regions the map has, and which of them are being optimised."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from rclpy.parameter import Parameter
from rclpy.timer import Timer
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from meslam_core.errors import MapError
from meslam_interfaces.msg import Region, RegionArray, RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import to_stamp
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, OK, STALE, WARN, Diagnostics
from meslam_ros.managed_node import ManagedNode, run
from meslam_ros.markers import region_markers
from meslam_ros.node_settings import MapFrameSettings, RegionManagerSettings
from meslam_ros.parameters import declare_config, declare_settings, read_config
from meslam_ros.qos import MODELS_DEPTH, STREAM, latched
from meslam_ros.region_catalog import RegionCatalog, RegionEntry, check_payload, region_index
from meslam_ros.rgbd_input import STEADY


class RegionManagerNode(ManagedNode):
    """Joins the regions' models with tracking's word on which of them work."""

    def __init__(self, **options: Any) -> None:
        super().__init__("region_manager_node", **options)
        self._frames = declare_settings(self, MapFrameSettings)
        self._settings = declare_settings(self, RegionManagerSettings)
        self._config = declare_config(self, ("regions",))
        self._catalog = RegionCatalog()
        self._live_map_id = ""
        self._refused = 0
        self._changed = False
        self._timer: Timer | None = None
        self.add_post_set_parameters_callback(self._retime)

    def configure(self) -> None:
        self._config = read_config(self)
        self._regions = self.create_publisher(RegionArray, topics.REGIONS, latched())
        self._markers = self.create_publisher(MarkerArray, topics.REGION_MARKERS, latched())
        self._diagnostics = Diagnostics(self)

    def activate(self) -> None:
        self._models = self.create_subscription(
            RegionModel, topics.REGION_MODELS, self._take_model, latched(MODELS_DEPTH)
        )
        self._status = self.create_subscription(
            TrackingStatus, topics.STATUS, self._take_status, STREAM
        )
        self._changed = True
        self._timer = self._ticking()
        self._diagnosis = self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY)

    def _ticking(self) -> Timer:
        period_s = self.get_parameter("regions_period_s").value
        return self.create_timer(float(period_s), self._tick, clock=STEADY)

    def _retime(self, changed: Sequence[Parameter]) -> None:
        """Follow a changed period at once; a timer alone would first end the old one."""
        if self._timer is not None and any(p.name == "regions_period_s" for p in changed):
            self.destroy_timer(self._timer)
            self._timer = self._ticking()

    def deactivate(self) -> None:
        for timer in (self._timer, self._diagnosis):
            self.destroy_timer(timer)
        self._timer = None
        self.destroy_subscription(self._models)
        self.destroy_subscription(self._status)

    def cleanup(self) -> None:
        self._diagnostics.close()
        self.destroy_publisher(self._regions)
        self.destroy_publisher(self._markers)
        self._catalog.begin("")

    def _take_model(self, model: RegionModel) -> None:
        if self._live_map_id not in ("", model.map_id) or not self._catalog.is_news(model):
            return
        try:
            check_payload(model)
            entry = RegionEntry.of(model)
            if model.map_id != self._catalog.map_id:
                self._catalog.begin(model.map_id)
            is_new = entry.index not in self._catalog.entries
            self._catalog.add(entry)
        except MapError as error:
            self._refused += 1
            self.get_logger().error(f"region model refused: {error}")
            return
        self._changed = True
        if is_new:
            self._publish()

    def _take_status(self, status: TrackingStatus) -> None:
        self._live_map_id = status.map_id
        if status.map_id != self._catalog.map_id:
            self._catalog.begin(status.map_id)
            self._publish()
        training = {region_index(entry.index) for entry in status.training_regions}
        if self._catalog.set_active(region_index(status.working_region), training):
            self._publish()

    def _tick(self) -> None:
        if self._changed:
            self._publish()

    def _publish(self) -> None:
        self._changed = False
        self._regions.publish(
            self._catalog.message(self._frames.map_frame, self._config.regions.overlap)
        )
        header = Header(
            stamp=to_stamp(self._catalog.newest_stamp_ns), frame_id=self._frames.map_frame
        )
        self._markers.publish(
            MarkerArray(markers=region_markers(self._catalog.entries.values(), header))
        )

    def _diagnose(self) -> None:
        entries = self._catalog.entries.values()
        states = [entry.state for entry in entries]
        level, message = (OK, f"{len(entries)} regions") if entries else (STALE, "no region yet")
        if self._refused:
            level, message = WARN, f"region models refused: {self._refused}"
        self._diagnostics.report(
            level,
            message,
            {
                "refused": self._refused,
                "regions": len(entries),
                "training": states.count(Region.TRAINING),
                "working": states.count(Region.WORKING),
                "map_bytes": sum(entry.size for entry in entries),
            },
        )


def main() -> None:
    """Entry point."""
    sys.exit(run(RegionManagerNode))


if __name__ == "__main__":
    main()
