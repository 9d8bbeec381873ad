"""/meslam/region_models: every region that changed, at a bounded rate."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Iterable

from rclpy.node import Node
from rclpy.publisher import Publisher

from meslam_core.errors import MapError
from meslam_core.map.codec import decode
from meslam_core.map.stored_region import StoredRegion, snapshot
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.region import Region
from meslam_interfaces.msg import RegionModel
from meslam_ros import topics
from meslam_ros.qos import latched
from meslam_ros.region_messages import region_model


class ModelPublisher:
    """Encodes regions in a thread of its own and publishes them.

    Every region has a publisher that keeps its latest message: so who comes late gets each
    region once, however often others have been published since.

    Args:
        node: that publishes.
        map_frame: frame of the regions' poses.
        precision: of the weights.
        period_s: tells in what time a region is published at most once [s].
    """

    def __init__(
        self, node: Node, map_frame: str, precision: str, period_s: Callable[[], float]
    ) -> None:
        self._node = node
        self._map_frame = map_frame
        self._precision = precision
        self._period_s = period_s
        self._map_id = ""
        self._publishers: dict[RegionIndex, Publisher] = {}
        self._offered: dict[RegionIndex, tuple[int, float]] = {}
        self._bytes: dict[RegionIndex, int] = {}
        self._waiting: dict[RegionIndex, tuple[str, StoredRegion]] = {}
        self._changed = threading.Condition()
        self._stopping = False
        self._busy = False
        self._thread = threading.Thread(target=self._run, name="region models", daemon=True)
        self._thread.start()

    @property
    def map_bytes(self) -> int:
        """Size of all regions published so far [bytes]."""
        return sum(list(self._bytes.values()))

    def begin(self, map_id: str) -> None:
        """Forget all regions; the next ones belong to a new map."""
        with self._changed:
            self._map_id = map_id
            self._waiting.clear()
            self._offered.clear()
            self._bytes.clear()
            publishers, self._publishers = list(self._publishers.values()), {}
        for publisher in publishers:
            self._node.destroy_publisher(publisher)

    def offer(self, regions: Iterable[Region], stamp_ns: int, final: bool = False) -> None:
        """Take what has changed for publication; called while nothing trains the regions.

        Args:
            regions: of the map.
            stamp_ns: of the newest image they were trained with [ns].
            final: also what was published a moment ago, for nothing more will come.
        """
        now = time.monotonic()
        for region in regions:
            version, offered_s = self._offered.get(region.index, (-1, float("-inf")))
            due = final or now - offered_s >= self._period_s()
            if region.version != version and due:
                self._offered[region.index] = region.version, now
                stored = _stored(region, stamp_ns)
                with self._changed:
                    self._waiting[region.index] = self._map_id, stored
                    self._changed.notify_all()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything offered is published; False when that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._waiting or self._busy), timeout_s)

    def close(self) -> None:
        """Stop; what waits is not published any more."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join()
        self.begin("")

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if self._stopping:
                    return
                index = next(iter(self._waiting))
                map_id, region = self._waiting.pop(index)
                self._busy = True
            try:
                message = region_model(region, map_id, self._map_frame, self._precision)
                self._publish(index, message)
            except MapError as error:
                self._node.get_logger().error(str(error))
            except Exception:
                self._node.get_logger().fatal(traceback.format_exc())
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _publish(self, index: RegionIndex, message: RegionModel) -> None:
        with self._changed:
            if message.map_id != self._map_id:
                return
            if index not in self._publishers:
                self._publishers[index] = self._node.create_publisher(
                    RegionModel, topics.REGION_MODELS, latched()
                )
            self._bytes[index] = len(message.data)
            self._publishers[index].publish(message)


def _stored(region: Region, stamp_ns: int) -> StoredRegion:
    """A region as it is now; as it was stored where an earlier session did and nothing changed."""
    if region.origin is not None and region.untouched:
        return decode(region.origin.data)
    return snapshot(region, stamp_ns)
