"""A stored map that tracking is told to go on with, and the session that is prepared for it."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from meslam_core import se3
from meslam_core.config import MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.errors import FrameError, MapError, MeslamError
from meslam_core.regions.grid import RegionGrid
from meslam_interfaces.srv import UseMap
from meslam_ros.conversions import from_pose
from meslam_ros.mapping_session import MappingSession
from meslam_ros.region_messages import model_name, stored_region

MODES = (UseMap.Request.CONTINUE, UseMap.Request.LOCALISE)


@dataclass(frozen=True)
class GivenMap:
    """What a request to track in a map asks for.

    Attributes:
        continuation: the map; its pose is not known yet.
        T_map_base: (4, 4), where the base is in it; None for where it is now if that is the same
            map, else for the map's origin.
    """

    continuation: Continuation
    T_map_base: se3.Pose | None

    @classmethod
    def of(cls, request: UseMap.Request, config: MeslamConfig) -> GivenMap:
        """The map of a request, after every check.

        Raises:
            MapError: when it is damaged, contradicts itself or cannot be gone on with.
            FrameError: when the start pose is none.
        """
        if request.mode not in MODES:
            raise FrameError(f"there is no mode {request.mode}; CONTINUE is 1, LOCALISE is 2")
        if not request.regions:
            raise MapError("the map holds no region to track in")
        regions = []
        for model in request.regions:
            if model.map_id != request.map_id:
                raise MapError(f"{model_name(model)} is of the map {model.map_id!r}, not of this")
            regions.append((stored_region(model), bytes(model.data)))
        places = {region.index for region, _ in regions}
        if len(places) < len(regions):
            raise MapError(f"{len(regions)} regions have {len(places)} places; each has its own")
        continuation = Continuation(
            request.map_id,
            _grid(request),
            regions,
            np.eye(4),
            train=request.mode == UseMap.Request.CONTINUE,
        )
        continuation.adapted(config)
        start = from_pose(request.start_pose) if request.use_start_pose else None
        return cls(continuation, start)

    @property
    def map_id(self) -> str:
        """Identity of the map."""
        return self.continuation.map_id


class Preparation:
    """Makes the session of a given map in a thread, while tracking goes on in the present one.

    Args:
        given: the map.
        make: the session; takes seconds for a large map.
        T_map_base: (4, 4), where the base is in the present map as the request comes; None where
            it has no pose.
        present_id: identity of the present map.

    Attributes:
        error: why it failed; empty as long as it has not.
    """

    def __init__(
        self,
        given: GivenMap,
        make: Callable[[GivenMap], MappingSession],
        T_map_base: se3.Pose | None,
        present_id: str,
    ) -> None:
        self.given = given
        self.error = ""
        self._make = make
        self._T_present_base = T_map_base
        self._same = present_id == given.map_id
        self._session: MappingSession | None = None
        self._thread = threading.Thread(target=self._run, name="given map", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether the session is ready, or cannot be made."""
        return not self._thread.is_alive()

    def session(self, T_map_base: se3.Pose | None) -> MappingSession | None:
        """The session, told where it begins; waits for it. None where it could not be made.

        Args:
            T_map_base: (4, 4), where the base is in the present map now: since the request it has
                moved on.
        """
        self._thread.join()
        if self._session is None:
            return None
        start = self.given.T_map_base
        if start is None and self._same:
            start = self._T_present_base
        if start is not None and T_map_base is not None and self._T_present_base is not None:
            start = se3.orthonormalized(start @ se3.inverse(self._T_present_base) @ T_map_base)
        self._session.begin_at(start)
        return self._session

    def _run(self) -> None:
        try:
            self._session = self._make(self.given)
        except MeslamError as error:
            self.error = str(error)
        except Exception:
            self.error = traceback.format_exc()


def _grid(request: UseMap.Request) -> RegionGrid:
    origin = np.array([getattr(request.lattice_origin, axis) for axis in "xyz"])
    side_m, overlap = request.lattice_side_m, round(float(request.overlap), 6)
    if not (np.isfinite(origin).all() and 0.0 < side_m < 1e4 and 0.0 <= overlap < 1.0):
        raise MapError(
            f"a lattice of {side_m} m boxes about {origin} with an overlap of {overlap} is none"
        )
    return RegionGrid(origin, side_m, overlap)
