"""The viewer: a page, and the background work that fills it."""

from __future__ import annotations

from meslam_core.viewer.background_map import BackgroundMap
from meslam_core.viewer.page import Page
from meslam_core.viewer.scene import Scene, ViewControls
from meslam_core.viewer.server import DEFAULT_HOST, DEFAULT_PORT


class Viewer:
    """A scene on a page, with the meshes of the models that it is given.

    Args:
        host, port: where the page is served, as of `PageServer`.
        controls: what is shown at first.
        eager: make the mesh before somebody looks, too.

    Raises:
        ConfigError: when the address is not this computer's.
    """

    def __init__(
        self,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        controls: ViewControls | None = None,
        eager: bool = False,
    ) -> None:
        self.scene = Scene()
        self.controls = controls or ViewControls()
        self.page = Page(self.scene, self.controls, host, port, self._export)
        self.map = BackgroundMap(self.scene, self.controls, lambda: eager or self.page.viewers > 0)

    def _export(self, resolution_m: float, suffix: str) -> bytes:
        return self.map.export(resolution_m, suffix)

    def close(self) -> None:
        """Take the page away and end the background work."""
        self.page.close()
        self.map.close()
