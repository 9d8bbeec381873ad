"""The page in the browser: shows a scene to everybody who looks, and follows it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from meslam_core.viewer.canvas import Canvas, follow, look_over
from meslam_core.viewer.panel import Panel
from meslam_core.viewer.scene import CameraView, Part, Scene, ViewControls
from meslam_core.viewer.server import PageServer

T = TypeVar("T")

logger = logging.getLogger(__name__)

TICK_S = 0.07
IMAGE_PERIOD_S = 0.2
PATH_PERIOD_S = 0.4
LONG_PATH = 2000
STATUS_PERIOD_S = 0.3
BRAND_COLOR = (56, 160, 102)


class Page:
    """Shows a scene at `url` until it is closed.

    What has changed is sent at most 14 times a second, images 5 times, and nothing while nobody
    looks. Who looks can change what is shown, to all alike, and nothing of the map.

    Args:
        scene: to show.
        controls: set by the panel.
        host, port: as of `PageServer`.
        export: as of `Panel`.

    Raises:
        ConfigError: when the address is not this computer's.
    """

    def __init__(
        self,
        scene: Scene,
        controls: ViewControls,
        host: str,
        port: int,
        export: Callable[[float, str], bytes],
    ) -> None:
        self._scene = scene
        self._controls = controls
        self._server = PageServer(host, port)
        self._shown: dict[str, tuple[int, float]] = {}
        self._told: tuple[tuple[int, ...], float] = ((), float("-inf"))
        self._canvas = Canvas(self._server.scene)
        self._server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=BRAND_COLOR
        )
        self._server.gui.main_panel.dock_right()
        self._panel = Panel(
            self._server.gui, controls, self._canvas.set_visible, self._look_over, export
        )
        self._server.on_client_connect(self._look_over)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Of the page, as seen from this computer."""
        return self._server.url

    @property
    def gui(self) -> viser.GuiApi:
        """For further controls."""
        return self._server.gui

    @property
    def viewers(self) -> int:
        """How many browsers show the page."""
        return len(self._server.get_clients())

    def close(self) -> None:
        """Take the page away."""
        self._stopping.set()
        self._thread.join()
        self._server.stop()

    def _run(self) -> None:
        while not self._stopping.wait(TICK_S):
            if not self.viewers or self._controls.paused:
                continue
            try:
                self._update()
            except Exception:
                logger.exception("the viewer's page cannot be renewed")
                self._stopping.wait(1.0)

    def _update(self) -> None:
        """Send what has changed since it was shown, and is due."""
        scene, canvas = self._scene, self._canvas
        with self._server.atomic():
            self._renew("camera", scene.camera, self._show_camera)
            self._renew("image", scene.image, self._show_image, IMAGE_PERIOD_S)
            self._renew_path("online_path", scene.online_path)
            self._renew_path("refined_path", scene.refined_path)
            self._renew("regions", scene.regions, canvas.regions)
            self._renew("mesh", scene.surfaces, canvas.surfaces)
            self._renew("occupancy", scene.occupancy, canvas.occupancy)
            self._renew_status()
        canvas.take_leave()

    def _renew(
        self, name: str, part: Part[T], show: Callable[[T], object], period_s: float = 0.0
    ) -> None:
        revision, shown_s = self._shown.get(name, (0, float("-inf")))
        now = time.monotonic()
        if part.revision != revision and now - shown_s >= period_s:
            self._shown[name] = part.revision, now
            show(part.value)

    def _show_camera(self, view: CameraView | None) -> None:
        self._canvas.camera(view)
        if view is not None and self._panel.following:
            for client in self._server.get_clients().values():
                follow(client.camera, view.T_map_camera)

    def _show_image(self, image: NDArray[np.uint8] | None) -> None:
        self._canvas.image(image)
        if image is not None:
            self._panel.show_image(image)

    def _renew_path(self, name: str, path: Part[NDArray[np.float64]]) -> None:
        """Send a path, which is sent whole, less often when it grows long."""
        period_s = PATH_PERIOD_S * (1.0 + len(path.value) / LONG_PATH)
        self._renew(name, path, lambda positions: self._canvas.path(name, positions), period_s)

    def _renew_status(self) -> None:
        """Tell the figures, which are those of several parts."""
        parts = (self._scene.status, self._scene.regions, self._scene.surfaces)
        revisions, now = tuple(part.revision for part in parts), time.monotonic()
        if revisions != self._told[0] and now - self._told[1] >= STATUS_PERIOD_S:
            self._told = revisions, now
            self._panel.show_status(self._scene)

    def _look_over(self, client: viser.ClientHandle) -> None:
        look_over(client.camera, self._scene.bounds)
