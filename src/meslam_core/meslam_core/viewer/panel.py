"""The page's side panel: how tracking is doing, what is shown, and the map to take away."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.map.mesh_file import FORMATS
from meslam_core.viewer.scene import Scene, Status, ViewControls

STATE_COLORS = {
    "OK": "#2f9e44",
    "DEGRADED": "#e8890c",
    "LOST": "#e03131",
    "RELOCALISING": "#e8890c",
}
NEUTRAL_COLOR = "#5c6370"
LAYERS = {
    "mesh": "Mesh",
    "regions": "Regions",
    "camera": "Camera",
    "online_path": "Path, live",
    "refined_path": "Path, refined",
}
SPACING_RANGE_CM = (1.0, 20.0)
HEIGHT_RANGE_M = (-5.0, 5.0)
JPEG_QUALITY = 70
IMAGE_ORDER, TIMELINE_ORDER = 0.5, 0.7


class Panel:
    """Controls that all who look have in common.

    What a browser sends is checked here: it may be anything.

    Args:
        gui: of the server.
        controls: that follow the panel.
        show: called with a layer's name and whether it is to be seen.
        look_over: brings one viewer's eye back to where all is seen.
        export: makes a file of the map, given the spacing [m] and the file's ending.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        controls: ViewControls,
        show: Callable[[str, bool], None],
        look_over: Callable[[viser.ClientHandle], None],
        export: Callable[[float, str], bytes],
    ) -> None:
        self._gui = gui
        self._controls = controls
        self._show = show
        self._look_over = look_over
        self._export = export
        self._image: viser.GuiImageHandle | None = None
        self._status = gui.add_html(status_html(Scene()))
        self._pause = gui.add_checkbox("Pause", False, hint="the page stands still")
        self._pause.on_update(self._take_pause)
        self._follow = gui.add_checkbox("Follow the camera", False)
        gui.add_button("Overview", icon=viser.Icon.ZOOM_RESET).on_click(self._take_overview)
        with gui.add_folder("Show"):
            self._add_layers()
        with gui.add_folder("Mesh"):
            self._add_mesh()

    @property
    def following(self) -> bool:
        """Whether the eyes of all who look are to follow the camera."""
        return self._follow.value is True

    def show_status(self, scene: Scene) -> None:
        """Renew what the panel says."""
        self._status.content = status_html(scene)

    def show_image(self, image: NDArray[np.uint8]) -> None:
        """Show what the camera sees, (H, W, 3) uint8 RGB."""
        if self._image is None:
            self._image = self._gui.add_image(
                image, format="jpeg", jpeg_quality=JPEG_QUALITY, order=IMAGE_ORDER
            )
        else:
            self._image.image = image

    def _add_layers(self) -> None:
        gui = self._gui
        for name, label in LAYERS.items():
            self._add_layer(name, gui.add_checkbox(label, True))
        self._occupancy = gui.add_checkbox("Occupancy", self._controls.occupancy_shown)
        self._occupancy.on_update(self._take_occupancy)
        self._height = gui.add_slider(
            "Height [m]", *HEIGHT_RANGE_M, 0.05, self._controls.occupancy_height_m
        )
        self._height.on_update(self._take_occupancy)

    def _add_layer(self, name: str, box: viser.GuiCheckboxHandle) -> None:
        box.on_update(lambda _: self._show(name, box.value is True))

    def _add_mesh(self) -> None:
        gui = self._gui
        self._spacing = gui.add_slider(
            "Spacing [cm]", *SPACING_RANGE_CM, 0.5, 100.0 * self._controls.mesh_resolution_m
        )
        self._spacing.on_update(self._take_spacing)
        self._download = gui.add_button_group("Download", FORMATS)
        self._download.on_click(self._take_download)

    def _take_pause(self, _: object) -> None:
        self._controls.paused = self._pause.value is True

    def _take_overview(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        if event.client is not None:
            self._look_over(event.client)

    def _take_occupancy(self, _: object) -> None:
        shown = self._occupancy.value is True
        self._show("occupancy", shown)
        self._controls.occupancy_shown = shown
        height_m = within(self._height.value, HEIGHT_RANGE_M)
        if height_m is not None:
            self._controls.occupancy_height_m = height_m

    def _take_spacing(self, _: object) -> None:
        spacing_cm = within(self._spacing.value, SPACING_RANGE_CM)
        if spacing_cm is not None:
            self._controls.mesh_resolution_m = spacing_cm / 100.0

    def _take_download(self, event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
        """Send the map's mesh to one viewer's browser, which saves it; nothing is written here."""
        suffix = self._download.value
        if event.client is None or suffix not in FORMATS:
            return
        resolution_m = self._controls.mesh_resolution_m
        notice = event.client.add_notification(
            "Mesh", f"is made with a spacing of {100 * resolution_m:g} cm", loading=True
        )
        try:
            content = self._export(resolution_m, suffix)
        except MapError as error:
            event.client.add_notification("No mesh", str(error), color="red")
            return
        finally:
            notice.remove()
        event.client.send_file_download(f"meslam{suffix}", content, save_immediately=True)


def within(value: object, limits: tuple[float, float]) -> float | None:
    """A number that a browser has sent, brought into its range; None for anything else."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return min(max(float(value), limits[0]), limits[1])


def status_html(scene: Scene) -> str:
    """The table on top of the panel."""
    status = scene.status.value
    regions = scene.regions.value
    triangles = sum(surface.triangles for surface in scene.surfaces.value.values())
    rows = [
        ("Rate", _number(status.frames_per_s, "{:.1f} frames/s")),
        ("Latency", _number(status.latency_ms, "{:.0f} ms")),
        ("Frames", _frames(status)),
        ("Map", f"{status.map_bytes / 1000:.1f} kB" if status.map_bytes else ""),
        ("Volume", f"{status.observed_volume_m3:.1f} m³" if status.observed_volume_m3 else ""),
        ("Density", _number(status.bytes_per_m3, "{:,.0f} bytes/m³")),
        ("Regions", f"{len(regions)}" if regions else ""),
        ("Keyframes", _number(status.keyframes, "{:d}")),
        ("Mesh", f"{triangles:,} triangles" if triangles else ""),
    ]
    cells = "".join(
        f'<tr><td style="opacity:.65;padding-right:1em">{name}</td><td>{value}</td></tr>'
        for name, value in rows
        if value
    )
    color = STATE_COLORS.get(status.state, NEUTRAL_COLOR)
    badge = (
        f'<span style="background:{color};color:white;border-radius:4px;padding:2px 8px;'
        f'font-weight:600">{escape(status.state) or "WAITING"}</span>'
    )
    return (
        f'<div style="padding:.5em 1em;font-size:.85em;line-height:1.45">{badge} '
        f'<div style="margin:.4em 0">{escape(status.reason)}</div><table>{cells}</table></div>'
    )


def _frames(status: Status) -> str:
    if status.frames_tracked is None:
        return ""
    dropped = f", {status.frames_dropped} dropped" if status.frames_dropped else ""
    return f"{status.frames_tracked} tracked{dropped}"


def _number(value: float | int | None, form: str) -> str:
    return "" if value is None else form.format(value)
