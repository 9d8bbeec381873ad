"""Regions as messages: their models, their catalogue."""

from __future__ import annotations

import hashlib

import numpy as np
from geometry_msgs.msg import Vector3

from meslam_core.errors import FrameError, MapError
from meslam_core.map.codec import FORMAT, decode, encode
from meslam_core.map.stored_region import StoredRegion
from meslam_interfaces.msg import RegionModel
from meslam_ros.conversions import byte_array, from_pose, stamp_ns, to_pose, to_stamp
from meslam_ros.region_catalog import check_payload, model_name

SAME_POSE = 1e-6


def region_model(region: StoredRegion, map_id: str, map_frame: str, precision: str) -> RegionModel:
    """A region's network as a message; `data` is exactly its file in the map store.

    Raises:
        MapError: when the region holds values that the format cannot.
    """
    return encoded_model(region, encode(region, precision), map_id, map_frame)


def encoded_model(region: StoredRegion, data: bytes, map_id: str, map_frame: str) -> RegionModel:
    """The message of a region that is encoded already."""
    message = RegionModel(
        map_id=map_id,
        index=np.array(region.index, np.int32),
        version=region.version,
        pose=to_pose(region.T_map_region),
        size_m=Vector3(x=region.side_m, y=region.side_m, z=region.side_m),
        keyframes=region.keyframes,
        observed_volume_m3=region.mask.observed_volume_m3,
        format=FORMAT,
        sha256=hashlib.sha256(data).hexdigest(),
        data=byte_array(data),
    )
    message.header.stamp = to_stamp(region.stamp_ns)
    message.header.frame_id = map_frame
    return message


def _same_box(message: RegionModel, region: StoredRegion) -> bool:
    """Whether a message's header has the pose and size of the region that it holds."""
    try:
        T_map_region = from_pose(message.pose)
    except FrameError:
        return False
    return message.size_m.x == region.side_m and np.allclose(
        T_map_region, region.T_map_region, rtol=0.0, atol=SAME_POSE
    )


def stored_region(message: RegionModel) -> StoredRegion:
    """The region of a message, after every check.

    Raises:
        MapError: when it is damaged, of another format, or contradicts its own header.
    """
    check_payload(message)
    name = model_name(message)
    region = decode(bytes(message.data), name)
    if region.index != tuple(message.index) or region.version != message.version:
        raise MapError(f"{name} holds {region.index} version {region.version} inside")
    if region.stamp_ns != stamp_ns(message.header.stamp):
        raise MapError(f"{name}: the stamps inside and outside differ")
    if not _same_box(message, region):
        raise MapError(f"{name}: the boxes inside and outside differ")
    return region
