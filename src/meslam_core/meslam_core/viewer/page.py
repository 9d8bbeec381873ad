"""The page in the browser: shows a scene to everybody who looks, and follows it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from meslam_core import se3
from meslam_core.regions.grid import RegionIndex
from meslam_core.viewer.panel import Panel
from meslam_core.viewer.scene import (
    CameraView,
    OccupancySlice,
    Part,
    RegionBox,
    RegionState,
    Scene,
    Surface,
    ViewControls,
)
from meslam_core.viewer.server import PageServer

logger = logging.getLogger(__name__)

Color = tuple[int, int, int]

TICK_S = 0.04
IMAGE_PERIOD_S = 0.08
PATH_PERIOD_S = 0.4
STATUS_PERIOD_S = 0.3
# The new mesh is there before the old one goes.
MESH_HANDOVER_S = 0.7
STATE_COLORS: dict[RegionState, Color] = {
    RegionState.AT_REST: (150, 155, 165),
    RegionState.TRAINING: (242, 191, 51),
    RegionState.WORKING: (56, 201, 102),
}
ONLINE_COLOR: Color = (255, 140, 40)
REFINED_COLOR: Color = (70, 150, 255)
CAMERA_COLOR: Color = (235, 64, 120)
FREE_RGBA, OCCUPIED_RGBA, UNKNOWN_RGBA = (70, 170, 255, 90), (255, 60, 60, 235), (0, 0, 0, 0)
BOX_EDGES = [(a, a | 1 << axis) for axis in range(3) for a in range(8) if not a >> axis & 1]
# From behind the left, above: the map's x axis points away.
OVERVIEW_DIRECTION = np.array([-0.62, 0.42, 0.66])
OVERVIEW_DISTANCE = 0.95
FOLLOW_BACK_M, FOLLOW_UP_M = 1.6, 0.7
# glTF has y up, the map z.
WXYZ_MAP_GLTF = (0.5**0.5, 0.5**0.5, 0.0, 0.0)


class Page:
    """Shows a scene at `url` until it is closed.

    What has changed is sent at most 25 times a second, images 12 times, and nothing while nobody
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
        export: Callable[[float, str], bytes] | None = None,
    ) -> None:
        self._scene = scene
        self._controls = controls
        self._server = PageServer(host, port)
        self._visible: dict[str, bool] = {}
        self._shown: dict[str, tuple[int, float]] = {}
        self._nodes: dict[str, Any] = {}
        self._boxes: dict[RegionIndex, RegionBox] = {}
        self._surfaces: dict[RegionIndex, Surface] = {}
        self._leaving: list[tuple[float, Any]] = []
        self._set_up()
        self.panel = Panel(
            self._server.gui, controls, self._set_visible, self._look_over, export
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

    def _set_up(self) -> None:
        gui, scene = self._server.gui, self._server.scene
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=(56, 160, 102)
        )
        gui.main_panel.dock_right()
        scene.set_up_direction("+z")
        # Meshes are unlit: their colours hold the light of the scene.
        scene.configure_default_lights(enabled=False)
        scene.add_frame("/origin", axes_length=0.3, axes_radius=0.008)

    def _run(self) -> None:
        while not self._stopping.wait(TICK_S):
            if not self.viewers or self._controls.paused:
                continue
            try:
                self.update()
            except Exception:
                logger.exception("the viewer's page")
                self._stopping.wait(1.0)

    def update(self) -> None:
        """Send what has changed since it was shown, and is due."""
        scene, now = self._scene, time.monotonic()
        with self._server.atomic():
            self._renew("camera", scene.camera, 0.0, self._show_camera)
            self._renew("image", scene.image, IMAGE_PERIOD_S, self._show_image)
            self._renew("online_path", scene.online_path, PATH_PERIOD_S, self._show_online)
            self._renew("refined_path", scene.refined_path, PATH_PERIOD_S, self._show_refined)
            self._renew("regions", scene.regions, 0.0, self._show_regions)
            self._renew("mesh", scene.surfaces, 0.0, self._show_surfaces)
            self._renew("occupancy", scene.occupancy, 0.0, self._show_occupancy)
            self._renew("status", scene.status, STATUS_PERIOD_S, self._show_status)
        for due_s, node in list(self._leaving):
            if now >= due_s:
                node.remove()
                self._leaving.remove((due_s, node))

    def _renew(
        self, name: str, part: Part[Any], period_s: float, show: Callable[[Any], None]
    ) -> None:
        revision, shown_s = self._shown.get(name, (0, float("-inf")))
        now = time.monotonic()
        if part.revision != revision and now - shown_s >= period_s:
            self._shown[name] = part.revision, now
            show(part.value)

    def _show_camera(self, view: CameraView | None) -> None:
        if view is None:
            self._remove("camera")
            return
        wxyz, position = _placed(view.T_map_camera)
        node = self._nodes.get("camera")
        if node is None or node.aspect != view.aspect:
            self._nodes["camera"] = self._server.scene.add_camera_frustum(
                "/camera",
                view.vertical_fov_rad,
                view.aspect,
                scale=0.25,
                color=CAMERA_COLOR,
                format="jpeg",
                jpeg_quality=70,
                wxyz=wxyz,
                position=position,
                visible=self._visible.get("camera", True),
                cast_shadow=False,
                receive_shadow=False,
            )
        else:
            node.wxyz, node.position = wxyz, position
        if self.panel.follow.value:
            for client in self._server.get_clients().values():
                _follow(client.camera, view.T_map_camera)

    def _show_image(self, image: NDArray[np.uint8] | None) -> None:
        if image is not None:
            self.panel.show_image(image)
        if "camera" in self._nodes:
            self._nodes["camera"].image = image

    def _show_online(self, path: NDArray[np.float64]) -> None:
        self._show_path("online_path", path, ONLINE_COLOR)

    def _show_refined(self, path: NDArray[np.float64]) -> None:
        self._show_path("refined_path", path, REFINED_COLOR)

    def _show_path(self, name: str, path: NDArray[np.float64], color: Color) -> None:
        if len(path) < 2:
            self._remove(name)
            return
        self._nodes[name] = self._server.scene.add_line_segments(
            f"/{name}",
            np.stack([path[:-1], path[1:]], axis=1).astype(np.float32),
            color,
            thickness=2.5,
            thickness_units="screen",
            visible=self._visible.get(name, True),
        )

    def _show_regions(self, boxes: tuple[RegionBox, ...]) -> None:
        wanted = {box.index: box for box in boxes}
        for index in self._boxes.keys() - wanted.keys():
            self._remove(f"regions/{_name(index)}")
            self._remove(f"regions/{_name(index)}/label")
        for index, box in wanted.items():
            if not _same_box(self._boxes.get(index), box):
                self._show_box(box)
        self._boxes = wanted
        self._show_status(None)

    def _show_box(self, box: RegionBox) -> None:
        name, corners = f"regions/{_name(box.index)}", box.corners
        visible = self._visible.get("regions", True)
        self._nodes[name] = self._server.scene.add_line_segments(
            f"/{name}",
            corners[np.array(BOX_EDGES)].astype(np.float32),
            STATE_COLORS[box.state],
            thickness=1.5 if box.state is RegionState.AT_REST else 4.0,
            thickness_units="screen",
            visible=visible,
        )
        self._nodes[f"{name}/label"] = self._server.scene.add_label(
            f"/{name}/label",
            f"{' '.join(map(str, box.index))}: {box.state.value}, {box.size / 1000:.0f} kB",
            position=tuple(corners[-1]),
            visible=visible,
        )

    def _show_surfaces(self, surfaces: dict[RegionIndex, Surface]) -> None:
        for index in self._surfaces.keys() - surfaces.keys():
            self._remove(f"mesh/{_name(index)}")
        for index, surface in surfaces.items():
            if self._surfaces.get(index) is not surface:
                self._show_surface(index, surface)
        self._surfaces = surfaces
        self._show_status(None)

    def _show_surface(self, index: RegionIndex, surface: Surface) -> None:
        name = f"mesh/{_name(index)}"
        old = self._nodes.pop(name, None)
        if old is not None:
            self._leaving.append((time.monotonic() + MESH_HANDOVER_S, old))
        if surface.glb:
            self._nodes[name] = self._server.scene.add_glb(
                f"/{name}/{self._scene.surfaces.revision}",
                surface.glb,
                wxyz=WXYZ_MAP_GLTF,
                visible=self._visible.get("mesh", True),
                cast_shadow=False,
                receive_shadow=False,
            )

    def _show_occupancy(self, occupancy: OccupancySlice | None) -> None:
        if occupancy is None or not occupancy.cells.size:
            self._remove("occupancy")
            return
        height, width = occupancy.cells.shape
        extent_m = np.array([width, height]) * occupancy.resolution_m
        self._nodes["occupancy"] = self._server.scene.add_image(
            "/occupancy",
            occupancy_image(occupancy.cells),
            float(extent_m[0]),
            float(extent_m[1]),
            format="png",
            # An image's rows go down; this turns it about x, so that its rows go along y.
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=(*(occupancy.origin + 0.5 * extent_m), occupancy.height_m),
            visible=self._visible.get("occupancy", True),
            cast_shadow=False,
            receive_shadow=False,
        )

    def _show_status(self, _: object) -> None:
        self.panel.show_status(self._scene)

    def _remove(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()

    def _set_visible(self, layer: str, visible: bool) -> None:
        self._visible[layer] = visible
        for name, node in list(self._nodes.items()):
            if name == layer or name.startswith(f"{layer}/"):
                node.visible = visible

    def _look_over(self, client: viser.ClientHandle) -> None:
        """Bring a viewer's eye to where all of the map is seen."""
        low, high = self._scene.bounds
        middle = 0.5 * (low + high)
        distance = OVERVIEW_DISTANCE * float(np.linalg.norm(high - low))
        client.camera.up_direction = (0.0, 0.0, 1.0)
        client.camera.position = tuple(middle + distance * OVERVIEW_DIRECTION)
        client.camera.look_at = tuple(middle)


def occupancy_image(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    """RGBA (H, W, 4) of cells (H, W): unknown is clear, free blue, occupied red."""
    image = np.full((*cells.shape, 4), UNKNOWN_RGBA, np.uint8)
    image[cells == 0] = FREE_RGBA
    image[cells > 0] = OCCUPIED_RGBA
    return image


def _placed(T: se3.Pose) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Quaternion (w, x, y, z) and position of a pose (4, 4)."""
    x, y, z, w = se3.to_quaternion(T)
    return (float(w), float(x), float(y), float(z)), tuple(T[:3, 3].tolist())


def _follow(eye: viser.CameraHandle, T_map_camera: se3.Pose) -> None:
    """Look over the camera's shoulder."""
    ahead = T_map_camera[:3, 2]
    position = T_map_camera[:3, 3]
    eye.position = tuple(position - FOLLOW_BACK_M * ahead + [0.0, 0.0, FOLLOW_UP_M])
    eye.look_at = tuple(position + ahead)


def _same_box(known: RegionBox | None, box: RegionBox) -> bool:
    return known is not None and (
        (known.side_m, known.size, known.state) == (box.side_m, box.size, box.state)
        and np.array_equal(known.T_map_region, box.T_map_region)
    )


def _name(index: RegionIndex) -> str:
    return "_".join(map(str, index))
