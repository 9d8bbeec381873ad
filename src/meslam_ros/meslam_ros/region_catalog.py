"""Which regions a map has, from their models' messages."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from geometry_msgs.msg import Pose

from meslam_core.errors import FrameError, MapError
from meslam_core.regions.grid import MAX_REGIONS, RegionIndex
from meslam_interfaces.msg import Region, RegionArray, RegionModel
from meslam_ros.conversions import from_pose, stamp_ns, to_stamp

MAX_SIDE_M = 1000.0
MAX_MODEL_BYTES = 64 << 20


@dataclass(frozen=True)
class RegionEntry:
    """What is known of one region without decoding its network.

    Attributes:
        index: place on the lattice.
        version: of the model.
        pose: T_map_region.
        side_m: of the box [m].
        keyframes: that trained it.
        size: of the model [bytes].
        observed_volume_m3: seen by cameras [m^3].
        stamp_ns: of the newest image it was trained with [ns].
        state: AT_REST, TRAINING or WORKING of `meslam_interfaces/Region`.
    """

    index: RegionIndex
    version: int
    pose: Pose
    side_m: float
    keyframes: int
    size: int
    observed_volume_m3: float
    stamp_ns: int
    state: int = Region.AT_REST

    @classmethod
    def of(cls, model: RegionModel) -> RegionEntry:
        """The entry of a model.

        Raises:
            MapError: when its header cannot be that of a region.
        """
        sizes = model.size_m.x, model.observed_volume_m3
        try:
            from_pose(model.pose)
        except FrameError as error:
            raise MapError(f"{model_name(model)}: {error}") from error
        if not (0.0 < sizes[0] <= MAX_SIDE_M and 0.0 <= sizes[1] < math.inf):
            raise MapError(
                f"{model_name(model)}: a box of {sizes[0]} m of which {sizes[1]} m^3 were seen "
                "is none"
            )
        return cls(
            index=region_index(model.index),
            version=model.version,
            pose=model.pose,
            side_m=model.size_m.x,
            keyframes=model.keyframes,
            size=len(model.data),
            observed_volume_m3=model.observed_volume_m3,
            stamp_ns=stamp_ns(model.header.stamp),
        )


class RegionCatalog:
    """The newest entry of every region of one map, in the order of their creation.

    Attributes:
        map_id: of the map; empty as long as there is none.
        entries: by lattice index.
    """

    def __init__(self) -> None:
        self.map_id = ""
        self.entries: dict[RegionIndex, RegionEntry] = {}

    def begin(self, map_id: str) -> None:
        """Forget everything; another map begins."""
        self.map_id = map_id
        self.entries.clear()

    def is_news(self, model: RegionModel) -> bool:
        """Whether a model is of another map or newer than the one that is known."""
        known = self.entries.get(region_index(model.index))
        return model.map_id != self.map_id or known is None or model.version > known.version

    def add(self, entry: RegionEntry) -> None:
        """Take a region's newest entry; its state stays.

        Raises:
            MapError: when it is one more than can be stored.
        """
        known = self.entries.get(entry.index)
        if known is None and len(self.entries) >= MAX_REGIONS:
            raise MapError(f"region {list(entry.index)}: a map has at most {MAX_REGIONS} regions")
        self.entries[entry.index] = replace(entry, state=known.state if known else entry.state)

    def set_active(self, working: RegionIndex | None, training: set[RegionIndex]) -> bool:
        """Mark which regions are optimised; whether that is a change."""
        before = dict(self.entries)
        for index, entry in before.items():
            state = Region.TRAINING if index in training else Region.AT_REST
            self.entries[index] = replace(
                entry, state=Region.WORKING if index == working else state
            )
        return before != self.entries

    @property
    def newest_stamp_ns(self) -> int:
        """Stamp of the newest image in the map [ns]."""
        return max((entry.stamp_ns for entry in self.entries.values()), default=0)

    def message(self, map_frame: str, overlap: float) -> RegionArray:
        """All regions as a message."""
        entries = list(self.entries.values())
        working = [i for i, entry in enumerate(entries) if entry.state == Region.WORKING]
        message = RegionArray(
            map_id=self.map_id,
            overlap=overlap,
            working=working[0] if working else -1,
            regions=[_region(entry) for entry in entries],
        )
        message.header.stamp = to_stamp(self.newest_stamp_ns)
        message.header.frame_id = map_frame
        return message


def region_index(values: Iterable[int]) -> RegionIndex:
    """A lattice index from a message's array."""
    x, y, z = (int(value) for value in values)
    return x, y, z


def model_name(message: RegionModel) -> str:
    """How a region model is called in messages to people."""
    return f"region {list(map(int, message.index))} version {message.version}"


def check_payload(message: RegionModel) -> None:
    """Compare a model's data with what its header says of them, without decoding them.

    Raises:
        MapError: when they are of another format, too many, or damaged.
    """
    name = model_name(message)
    if message.format != RegionModel.FORMAT:
        raise MapError(
            f"{name} has the format {message.format!r}, this program reads "
            f"{RegionModel.FORMAT!r}; use the same MeSLAM on both computers"
        )
    if not 0 < len(message.data) <= MAX_MODEL_BYTES:
        raise MapError(f"{name} has {len(message.data)} bytes, expected 1 to {MAX_MODEL_BYTES}")
    if hashlib.sha256(message.data).hexdigest() != message.sha256:
        raise MapError(f"{name}: the checksum does not match; it was damaged on its way")


def _region(entry: RegionEntry) -> Region:
    message = Region(
        index=entry.index,
        state=entry.state,
        pose=entry.pose,
        version=entry.version,
        keyframes=entry.keyframes,
        bytes=entry.size,
        observed_volume_m3=entry.observed_volume_m3,
    )
    message.size_m.x = message.size_m.y = message.size_m.z = entry.side_m
    return message
