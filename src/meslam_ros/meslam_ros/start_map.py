"""The stored map that a map server starts with, for itself and on request for tracking."""

from __future__ import annotations

import threading
from collections.abc import Callable

from meslam_core.errors import MapError
from meslam_interfaces.srv import LoadMap
from meslam_ros.answers import Code, RequestError, answering
from meslam_ros.conversions import to_pose
from meslam_ros.node_settings import MapServerSettings
from meslam_ros.store_requests import StoreRequests
from meslam_ros.tracking_client import TrackingClient

MODES = {
    "view": LoadMap.Request.VIEW,
    "continue": LoadMap.Request.CONTINUE,
    "localise": LoadMap.Request.LOCALISE,
}
POLL_S = 0.5


class StartMap:
    """What the parameters `map`, `map_mode` and `map_start_pose` ask for.

    Args:
        settings: with these parameters.
        stores: that load maps.
        tracking: that is given the map as soon as it is there.
        inform, fail: take messages for people.
    """

    def __init__(
        self,
        settings: MapServerSettings,
        stores: StoreRequests,
        tracking: TrackingClient,
        inform: Callable[[str], object],
        fail: Callable[[str], object],
    ) -> None:
        self._settings = settings
        self._stores = stores
        self._tracking = tracking
        self._inform = inform
        self._fail = fail
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def load(self) -> bool:
        """Serve the map; False where none is asked for.

        Raises:
            MapError: when it is not there or cannot be read.
            ConfigError: when the start pose is none.
        """
        if not self._settings.map:
            return False
        response = LoadMap.Response()
        try:
            self._stores.load_map(self._request(LoadMap.Request.VIEW), response)
        except RequestError as error:
            raise MapError(f"the parameter map: {error}") from error
        self._inform(response.message)
        return True

    def start(self) -> None:
        """Give the map to tracking, where that is asked for and as soon as tracking is there."""
        mode = MODES[self._settings.map_mode]
        if not self._settings.map or mode == LoadMap.Request.VIEW:
            return
        self._closing.clear()
        self._thread = threading.Thread(
            target=self._give, args=(mode,), name="start map", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Do not wait for tracking any longer."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None

    def _give(self, mode: int) -> None:
        while not self._tracking.is_there(POLL_S):
            if self._closing.is_set():
                return
        load = answering(self._stores.load_map, self._fail)
        response: LoadMap.Response = load(self._request(mode), LoadMap.Response())
        tell = self._inform if response.result == Code.SUCCESS else self._fail
        tell(response.message)

    def _request(self, mode: int) -> LoadMap.Request:
        request = LoadMap.Request(name=self._settings.map, mode=mode)
        if self._settings.map_start_pose:
            request.use_start_pose = True
            # Brings all of mapping with it, which the server otherwise does without.
            from meslam_core.continuation import read_start_pose

            request.start_pose = to_pose(read_start_pose(self._settings.map_start_pose))
        return request
