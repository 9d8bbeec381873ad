"""The page's side panel: how tracking is doing, what is shown, and the map to take away."""

from __future__ import annotations

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
MESH_RANGE_CM = (1.0, 20.0)
HEIGHT_RANGE_M = (-5.0, 5.0)


class Panel:
    """Controls that all who look have in common.

    Args:
        gui: of the server.
        controls: that follow the panel.
        show: called with a layer's name and whether it is to be seen.
        look_over: brings one viewer's eye back to where all is seen.
        export: makes a file of the map, given the spacing [m] and the file's ending; None where
            the map is not given away.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        controls: ViewControls,
        show: Callable[[str, bool], None],
        look_over: Callable[[viser.ClientHandle], None],
        export: Callable[[float, str], bytes] | None,
    ) -> None:
        self._gui = gui
        self._controls = controls
        self._image: viser.GuiImageHandle | None = None
        self._status = gui.add_html(status_html(Scene()))
        self.pause = gui.add_checkbox("Pause", False, hint="the page stands still")
        self.follow = gui.add_checkbox("Follow the camera", False)
        overview = gui.add_button("Overview", icon=viser.Icon.ZOOM_RESET)
        overview.on_click(lambda event: event.client and look_over(event.client))
        self.pause.on_update(lambda _: setattr(controls, "paused", self.pause.value))
        self._add_layers(show)
        self._add_mesh(export)

    def _add_layers(self, show: Callable[[str, bool], None]) -> None:
        gui, controls = self._gui, self._controls
        with gui.add_folder("Show"):
            for name, label in LAYERS.items():
                box = gui.add_checkbox(label, True)
                box.on_update(
                    lambda event, name=name: show(name, event.target.value)  # type: ignore[misc]
                )
            occupancy = gui.add_checkbox("Occupancy", controls.occupancy_shown)
            height = gui.add_slider("Height [m]", *HEIGHT_RANGE_M, 0.05, controls.occupancy_height_m)

        @occupancy.on_update
        def _(_: object) -> None:
            controls.occupancy_shown = occupancy.value
            show("occupancy", occupancy.value)

        @height.on_update
        def _(_: object) -> None:
            controls.occupancy_height_m = float(height.value)

    def _add_mesh(self, export: Callable[[float, str], bytes] | None) -> None:
        gui, controls = self._gui, self._controls
        with gui.add_folder("Mesh"):
            spacing = gui.add_slider(
                "Spacing [cm]", *MESH_RANGE_CM, 0.5, 100.0 * controls.mesh_resolution_m
            )
            if export is not None:
                suffix = gui.add_dropdown("Format", FORMATS)
                button = gui.add_button("Download", icon=viser.Icon.DOWNLOAD)
                button.on_click(
                    lambda event: event.client
                    and download(event.client, button, export, spacing.value / 100.0, suffix.value)
                )

        @spacing.on_update
        def _(_: object) -> None:
            controls.mesh_resolution_m = spacing.value / 100.0

    def show_status(self, scene: Scene) -> None:
        """Renew what the panel says."""
        self._status.content = status_html(scene)

    def show_image(self, image: NDArray[np.uint8]) -> None:
        """Show what the camera sees, (H, W, 3) uint8 RGB."""
        if self._image is None:
            self._image = self._gui.add_image(image, format="jpeg", jpeg_quality=70, order=0.5)
        else:
            self._image.image = image


def download(
    client: viser.ClientHandle,
    button: viser.GuiButtonHandle,
    export: Callable[[float, str], bytes],
    resolution_m: float,
    suffix: str,
) -> None:
    """Send the map's mesh to one viewer's browser, which saves it; nothing is written here."""
    button.disabled = True
    notice = client.add_notification("Mesh", f"made at {100 * resolution_m:g} cm", loading=True)
    try:
        content = export(resolution_m, suffix)
    except MapError as error:
        notice.remove()
        client.add_notification("No mesh", str(error), color="red")
        return
    finally:
        button.disabled = False
    notice.remove()
    client.send_file_download(f"meslam{suffix}", content, save_immediately=True)


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
