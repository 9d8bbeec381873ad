"""What the viewer shows: plain data that one side sets and the page shows."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.regions.grid import RegionIndex
from meslam_core.se3 import Pose

T = TypeVar("T")
# The first region's surroundings: a map begins at the origin.
EMPTY_BOUNDS = np.array([[-1.5, -1.5, -1.2], [1.5, 1.5, 1.2]])


class RegionState(Enum):
    """What happens to a region now."""

    AT_REST = "at rest"
    TRAINING = "training"
    WORKING = "working"


@dataclass(frozen=True)
class RegionBox:
    """A region without its network.

    Attributes:
        index: place on the lattice.
        T_map_region: (4, 4), the origin is the box's centre [m].
        side_m: of the box [m].
        size: of its file [bytes].
        keyframes: that trained it.
        state: what happens to it now.
    """

    index: RegionIndex
    T_map_region: Pose
    side_m: float
    size: int
    keyframes: int
    state: RegionState = RegionState.AT_REST

    @property
    def corners(self) -> NDArray[np.float64]:
        """(8, 3) in the map frame [m]; the corner's number has a bit an axis, x the lowest."""
        signs = np.array([[n >> axis & 1 for axis in range(3)] for n in range(8)]) - 0.5
        corners: NDArray[np.float64] = (
            self.side_m * signs @ self.T_map_region[:3, :3].T + self.T_map_region[:3, 3]
        )
        return corners


@dataclass(frozen=True)
class CameraView:
    """Where the camera is and how wide it sees.

    Attributes:
        T_map_camera: (4, 4) of the optical frame [m].
        vertical_fov_rad: angle of view [rad].
        aspect: width over height.
    """

    T_map_camera: Pose
    vertical_fov_rad: float = 0.8
    aspect: float = 4.0 / 3.0


def camera_view(T_map_camera: Pose, camera: PinholeCamera | None) -> CameraView:
    """A camera of known or ordinary intrinsics at a pose."""
    if camera is None:
        return CameraView(T_map_camera)
    fov_rad = 2.0 * float(np.arctan(0.5 * camera.height / camera.fy))
    return CameraView(T_map_camera, fov_rad, camera.width / camera.height)


@dataclass(frozen=True)
class Surface:
    """The mesh of one region.

    Attributes:
        glb: binary glTF; empty where no surface was observed.
        triangles: number of them.
        bounds: lowest and highest corner (2, 3), map frame [m]; zeros where it is empty.
        version: of the region that it shows.
        resolution_m: spacing of its vertices [m].
    """

    glb: bytes
    triangles: int
    bounds: NDArray[np.float64]
    version: int
    resolution_m: float


@dataclass(frozen=True)
class OccupancySlice:
    """A horizontal slice of the map.

    Attributes:
        cells: (H, W) int8, row y and column x: -1 unknown, 0 free, 100 occupied.
        origin: (2,) x and y of cell (0, 0)'s lower corner, map frame [m].
        resolution_m: side of a cell [m].
        height_m: z of the map frame [m].
    """

    cells: NDArray[np.int8]
    origin: NDArray[np.float64]
    resolution_m: float
    height_m: float


@dataclass(frozen=True)
class Status:
    """How tracking and mapping are doing; None where that is not known.

    Attributes:
        state: of tracking, as in `/meslam/status`; empty before there is one.
        reason: why the state is not OK, or what the viewer waits for, for people.
        frames_per_s: that are tracked.
        frames_tracked, frames_dropped: so far.
        latency_ms: from an image's arrival to its pose [ms].
        map_bytes: size of all regions [bytes].
        observed_volume_m3: seen by cameras [m^3].
        keyframes: that the map is trained with.
    """

    state: str = ""
    reason: str = ""
    frames_per_s: float | None = None
    frames_tracked: int | None = None
    frames_dropped: int | None = None
    latency_ms: float | None = None
    map_bytes: int = 0
    observed_volume_m3: float = 0.0
    keyframes: int | None = None

    @property
    def bytes_per_m3(self) -> float | None:
        """Size of the map over the volume observed [bytes/m^3]; None while there is none."""
        return self.map_bytes / self.observed_volume_m3 if self.observed_volume_m3 > 0 else None


class Part(Generic[T]):
    """One thing that is shown, and how often it has been set; usable from any thread."""

    def __init__(self, value: T) -> None:
        self._lock = threading.Lock()
        self._value = value
        self._revision = 0

    @property
    def value(self) -> T:
        """What it is now; not to be modified."""
        return self._value

    @property
    def revision(self) -> int:
        """Grows with every `set`."""
        return self._revision

    def set(self, value: T) -> None:
        """Replace it."""
        with self._lock:
            self._value = value
            self._revision += 1


def _no_path() -> Part[NDArray[np.float64]]:
    return Part(np.zeros((0, 3)))


@dataclass
class Scene:
    """Everything that the page shows, each part with a revision of its own.

    Attributes:
        camera: None as long as there is no pose.
        image: (H, W, 3) uint8 RGB, what the camera sees; None without.
        online_path: (N, 3) positions of the camera as they were known live, map frame [m].
        refined_path: (N, 3) as they are known now [m].
        regions: of the map.
        surfaces: meshes by region.
        occupancy: a slice of the map; None when it is not wanted or there is none.
        status: of tracking and mapping.
    """

    camera: Part[CameraView | None] = field(default_factory=lambda: Part(None))
    image: Part[NDArray[np.uint8] | None] = field(default_factory=lambda: Part(None))
    online_path: Part[NDArray[np.float64]] = field(default_factory=_no_path)
    refined_path: Part[NDArray[np.float64]] = field(default_factory=_no_path)
    regions: Part[tuple[RegionBox, ...]] = field(default_factory=lambda: Part(()))
    surfaces: Part[dict[RegionIndex, Surface]] = field(default_factory=lambda: Part({}))
    occupancy: Part[OccupancySlice | None] = field(default_factory=lambda: Part(None))
    status: Part[Status] = field(default_factory=lambda: Part(Status()))

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) of what there is to see, map frame [m]."""
        points = [surface.bounds for surface in self.surfaces.value.values() if surface.glb]
        points = points or [box.corners for box in self.regions.value]
        points += [self.online_path.value, self.refined_path.value]
        joined = np.concatenate(points)
        if not len(joined):
            joined = EMPTY_BOUNDS
        return np.stack([joined.min(axis=0), joined.max(axis=0)])


@dataclass
class ViewControls:
    """What the viewer's user has chosen; the page sets it, those who feed the scene follow.

    Attributes:
        mesh_resolution_m: spacing of the mesh's vertices [m].
        occupancy_shown: whether the slice is wanted.
        occupancy_height_m: its z in the map frame [m].
        paused: whether the page stands still.
    """

    mesh_resolution_m: float = 0.04
    occupancy_shown: bool = False
    occupancy_height_m: float = 0.0
    paused: bool = False
