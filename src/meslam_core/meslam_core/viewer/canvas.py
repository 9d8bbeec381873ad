"""The page's three-dimensional part: camera, paths, regions, meshes and the occupancy slice."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from meslam_core import se3
from meslam_core.regions.grid import RegionIndex
from meslam_core.viewer.scene import (
    CameraView,
    OccupancySlice,
    RegionBox,
    RegionState,
    Surface,
)

Color = tuple[int, int, int]

# The new mesh is there before the old one goes.
MESH_HANDOVER_S = 0.7
MESH_NAMES = 32
STATE_COLORS: dict[RegionState, Color] = {
    RegionState.AT_REST: (150, 155, 165),
    RegionState.TRAINING: (242, 191, 51),
    RegionState.WORKING: (56, 201, 102),
}
ONLINE_COLOR: Color = (255, 140, 40)
REFINED_COLOR: Color = (70, 150, 255)
CAMERA_COLOR: Color = (235, 64, 120)
PATH_COLORS = {"online_path": ONLINE_COLOR, "refined_path": REFINED_COLOR}
FREE_RGBA, OCCUPIED_RGBA, UNKNOWN_RGBA = (70, 170, 255, 90), (255, 60, 60, 235), (0, 0, 0, 0)
CELL_PIXELS, MAX_PIXELS = 4, 2048
FRUSTUM_M = 0.3
JPEG_QUALITY = 70
BOX_EDGES = np.array([(a, a | 1 << axis) for axis in range(3) for a in range(8) if ~a >> axis & 1])
# From behind the left, above: the map's x axis points away.
OVERVIEW_DIRECTION = np.array([-0.55, 0.35, 0.76])
OVERVIEW_DISTANCE = 0.58
FOLLOW_BACK_M, FOLLOW_UP_M = 1.6, 0.7
# glTF has y up, the map z.
WXYZ_MAP_GLTF = (0.5**0.5, 0.5**0.5, 0.0, 0.0)


class Canvas:
    """Draws parts of a scene, all to everybody who looks; one thread draws.

    Args:
        space: of the server.
    """

    def __init__(self, space: viser.SceneApi) -> None:
        self._space = space
        self._nodes: dict[str, Any] = {}
        self._visible: dict[str, bool] = {}
        self._boxes: dict[RegionIndex, RegionBox] = {}
        self._surfaces: dict[RegionIndex, Surface] = {}
        self._meshes = 0
        self._leaving: list[tuple[float, Any]] = []
        space.set_up_direction("+z")
        # Meshes are unlit: their colours hold the light of the scene.
        space.configure_default_lights(enabled=False)
        space.add_frame("/origin", axes_length=0.3, axes_radius=0.008)

    def camera(self, view: CameraView | None) -> None:
        """The camera's frustum."""
        if view is None:
            self._remove("camera")
            return
        wxyz, position = _placed(view.T_map_camera)
        node = self._nodes.get("camera")
        if node is not None and node.aspect == view.aspect:
            node.wxyz, node.position = wxyz, position
            return
        self._nodes["camera"] = self._space.add_camera_frustum(
            "/camera",
            view.vertical_fov_rad,
            view.aspect,
            scale=FRUSTUM_M,
            color=CAMERA_COLOR,
            format="jpeg",
            jpeg_quality=JPEG_QUALITY,
            wxyz=wxyz,
            position=position,
            visible=self._is_visible("camera"),
            cast_shadow=False,
            receive_shadow=False,
        )

    def image(self, image: NDArray[np.uint8] | None) -> None:
        """What the camera sees, (H, W, 3) uint8 RGB, in its frustum."""
        if "camera" in self._nodes:
            self._nodes["camera"].image = image

    def path(self, name: str, path: NDArray[np.float64]) -> None:
        """A line through positions (N, 3) [m]; `name` is one of PATH_COLORS."""
        if len(path) < 2:
            self._remove(name)
            return
        self._nodes[name] = self._space.add_line_segments(
            f"/{name}",
            np.stack([path[:-1], path[1:]], axis=1).astype(np.float32),
            PATH_COLORS[name],
            thickness=2.5,
            thickness_units="screen",
            visible=self._is_visible(name),
        )

    def regions(self, boxes: tuple[RegionBox, ...]) -> None:
        """The edges of all regions' boxes, coloured by their states."""
        wanted = {box.index: box for box in boxes}
        for index in self._boxes.keys() - wanted.keys():
            self._remove(f"regions/{_name(index)}")
            self._remove(f"regions/{_name(index)}/label")
        for index, box in wanted.items():
            if not _same_box(self._boxes.get(index), box):
                self._box(box)
        self._boxes = wanted

    def _box(self, box: RegionBox) -> None:
        name, corners = f"regions/{_name(box.index)}", box.corners
        self._nodes[name] = self._space.add_line_segments(
            f"/{name}",
            corners[BOX_EDGES].astype(np.float32),
            STATE_COLORS[box.state],
            thickness=1.5 if box.state is RegionState.AT_REST else 4.0,
            thickness_units="screen",
            visible=self._is_visible("regions"),
        )
        self._nodes[f"{name}/label"] = self._space.add_label(
            f"/{name}/label",
            f"{' '.join(map(str, box.index))}: {box.state.value}, {box.size / 1000:.0f} kB",
            position=_vector(corners[-1]),
            visible=self._is_visible("regions"),
        )

    def surfaces(self, surfaces: dict[RegionIndex, Surface]) -> None:
        """The meshes of all regions; only those that have changed are sent."""
        for index in self._surfaces.keys() - surfaces.keys():
            self._remove(f"mesh/{_name(index)}")
        for index, surface in surfaces.items():
            if self._surfaces.get(index) is not surface:
                self._surface(f"mesh/{_name(index)}", surface.glb)
        self._surfaces = surfaces

    def _surface(self, name: str, glb: bytes) -> None:
        old = self._nodes.pop(name, None)
        if old is not None:
            self._leaving.append((time.monotonic() + MESH_HANDOVER_S, old))
        if not glb:
            return
        # A node whose mesh changes shows nothing until the browser has read the new one.
        # Names come again, for the server remembers every name that was ever removed.
        self._meshes = (self._meshes + 1) % MESH_NAMES
        self._nodes[name] = self._space.add_glb(
            f"/{name}/{self._meshes}",
            glb,
            wxyz=WXYZ_MAP_GLTF,
            visible=self._is_visible("mesh"),
            cast_shadow=False,
            receive_shadow=False,
        )

    def take_leave(self) -> None:
        """Remove the meshes whose successors are there; to be called now and then."""
        now = time.monotonic()
        for _, node in (entry for entry in self._leaving if entry[0] <= now):
            node.remove()
        self._leaving = [entry for entry in self._leaving if entry[0] > now]

    def occupancy(self, occupancy: OccupancySlice | None) -> None:
        """The slice as an image that lies in the map."""
        if occupancy is None or not occupancy.cells.size:
            self._remove("occupancy")
            return
        height, width = occupancy.cells.shape
        extent_m = np.array([width, height]) * occupancy.resolution_m
        x, y = occupancy.origin + 0.5 * extent_m
        self._nodes["occupancy"] = self._space.add_image(
            "/occupancy",
            occupancy_image(occupancy.cells),
            float(extent_m[0]),
            float(extent_m[1]),
            format="png",
            position=_vector(np.array([x, y, occupancy.height_m])),
            visible=self._is_visible("occupancy"),
            cast_shadow=False,
            receive_shadow=False,
        )

    def set_visible(self, layer: str, visible: bool) -> None:
        """Show or hide one of `panel.LAYERS`, also what is drawn of it later."""
        self._visible[layer] = visible
        for name, node in list(self._nodes.items()):
            if name == layer or name.startswith(f"{layer}/"):
                node.visible = visible

    def _is_visible(self, layer: str) -> bool:
        return self._visible.get(layer, True)

    def _remove(self, name: str) -> None:
        node = self._nodes.pop(name, None)
        if node is not None:
            node.remove()


def look_over(eye: viser.CameraHandle, bounds: NDArray[np.float64]) -> None:
    """Bring a viewer's eye to where all between two corners (2, 3) is seen [m]."""
    low, high = bounds
    middle = 0.5 * (low + high)
    distance = OVERVIEW_DISTANCE * float(np.linalg.norm(high - low))
    eye.up_direction = (0.0, 0.0, 1.0)
    eye.position = _vector(middle + distance * OVERVIEW_DIRECTION)
    eye.look_at = _vector(middle)


def follow(eye: viser.CameraHandle, T_map_camera: se3.Pose) -> None:
    """Bring a viewer's eye behind the camera, whose pose is (4, 4)."""
    position, ahead = T_map_camera[:3, 3], T_map_camera[:3, 2]
    eye.position = _vector(position - FOLLOW_BACK_M * ahead + [0.0, 0.0, FOLLOW_UP_M])
    eye.look_at = _vector(position + ahead)


def occupancy_image(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    """RGBA of cells (H, W), several pixels a cell: unknown is clear, free blue, occupied red."""
    image = np.full((*cells.shape, 4), UNKNOWN_RGBA, np.uint8)
    image[cells == 0] = FREE_RGBA
    image[cells > 0] = OCCUPIED_RGBA
    # The browser smooths what it enlarges; so little is left of that.
    times = max(1, min(CELL_PIXELS, MAX_PIXELS // max(cells.shape)))
    return image.repeat(times, axis=0).repeat(times, axis=1)


def _placed(
    T: se3.Pose,
) -> tuple[tuple[float, float, float, float], tuple[float, float, float]]:
    """Quaternion (w, x, y, z) and position of a pose (4, 4)."""
    x, y, z, w = map(float, se3.to_quaternion(T))
    return (w, x, y, z), _vector(T[:3, 3])


def _vector(values: NDArray[np.floating]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _same_box(known: RegionBox | None, box: RegionBox) -> bool:
    return known is not None and (
        (known.side_m, known.size, known.state) == (box.side_m, box.size, box.state)
        and np.array_equal(known.T_map_region, box.T_map_region)
    )


def _name(index: RegionIndex) -> str:
    return "_".join(map(str, index))
