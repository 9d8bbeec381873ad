"""The map as requests get to it: refused while it is empty, and bounded."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from meslam_ros.answers import Code, RequestError
from meslam_ros.conversions import to_stamp
from meslam_ros.map_models import MapModels, MapSnapshot
from meslam_ros.node_settings import MapServerSettings

Box = tuple[NDArray[np.float64], NDArray[np.float64]]


class ServedMap:
    """What all requests ask about, and the limits of what they may ask for.

    Args:
        models: the map.
        settings: limits and folders.
        map_frame: of everything in the answers.
    """

    def __init__(self, models: MapModels, settings: MapServerSettings, map_frame: str) -> None:
        self.models = models
        self.settings = settings
        self.map_frame = map_frame

    def snapshot(self) -> MapSnapshot:
        """The map as it is now.

        Raises:
            RequestError: when it is empty.
        """
        if not self.models.entries():
            raise RequestError(Code.EMPTY_MAP, "the map holds nothing yet")
        return self.models.snapshot()

    def header(self, snapshot: MapSnapshot) -> Header:
        """Stamp of the newest image in the map, and its frame."""
        return Header(stamp=to_stamp(snapshot.stamp_ns), frame_id=self.map_frame)

    def resolution(self, requested_m: float, default_m: float) -> float:
        """The spacing to use [m]; 0 asks for the default.

        Raises:
            RequestError: when it is outside the limits.
        """
        if requested_m == 0.0:
            return default_m
        low, high = self.settings.min_resolution_m, self.settings.max_resolution_m
        # The request has single precision: 0.005 comes as 0.004999999888.
        resolution_m = round(float(requested_m), 6) if np.isfinite(requested_m) else requested_m
        if not low <= resolution_m <= high:
            raise RequestError(
                Code.INVALID_REQUEST,
                f"a resolution of {requested_m:g} m is outside {low:g} to {high:g} m; 0 takes "
                f"the default of {default_m:g} m",
            )
        return resolution_m

    def limit_cells(self, cells: float) -> None:
        """Refuse what needs more cells than the limit, and numbers that are none.

        Raises:
            RequestError: when that is so.
        """
        if not cells <= self.settings.max_cells:
            raise RequestError(
                Code.TOO_LARGE,
                f"{cells:.2g} cells exceed the limit max_cells = {self.settings.max_cells:.2g}; "
                "ask for a coarser resolution or a smaller part",
            )


def requested_box(request: Any, axes: str = "xyz") -> Box | None:
    """Lowest and highest corner of a request's box [m]; None where it asks for none.

    Args:
        request: with `use_box`, `box_min` and `box_max`.
        axes: that are read.

    Raises:
        RequestError: when the box is empty or not finite.
    """
    if not request.use_box:
        return None
    low = np.array([getattr(request.box_min, axis) for axis in axes])
    high = np.array([getattr(request.box_max, axis) for axis in axes])
    if not np.isfinite([low, high]).all() or not (low < high).all():
        raise RequestError(
            Code.INVALID_REQUEST,
            f"the box from {low} to {high} is empty; give finite corners, the lowest first",
        )
    return low, high
