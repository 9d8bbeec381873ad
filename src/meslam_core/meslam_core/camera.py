"""The pinhole camera: projection, back-projection and registration of depth to colour."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import FrameError
from meslam_core.input_file import read_file
from meslam_core.se3 import Pose

MAX_PIXELS = 1 << 26
"""Images larger than this are refused before memory is taken for them."""
MAX_SIDE_PX = 1 << 15
LEAST_FOCAL_PX, MOST_FOCAL_PX = 1e-2, 1e6
MAX_DESCRIPTION_BYTES = 1 << 20
MAX_COARSENESS = 64
"""Pixels of a colour image along a side that one pixel of its depth image may cover."""

# A camera that looks along its body's x axis, z up (REP-103); so looks the first one of a map.
T_BODY_OPTICAL: Pose = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of an undistorted camera; x right, y down, z forward (REP-103 optical frame).

    Pixel (u, v) is the centre of the pixel in column u and row v.

    Attributes:
        width, height: image size [px].
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].

    Raises:
        FrameError: when a size, a focal length or the principal point is none of a camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        focal = all(LEAST_FOCAL_PX <= f <= MOST_FOCAL_PX for f in values[:2])
        usable = focal and all(abs(c) <= MOST_FOCAL_PX for c in values[2:])
        sides = all(0 < side <= MAX_SIDE_PX for side in (self.width, self.height))
        if not usable or not sides or self.width * self.height > MAX_PIXELS:
            raise FrameError(
                f"camera intrinsics are unusable: {self.width}x{self.height} fx={self.fx} "
                f"fy={self.fy} cx={self.cx} cy={self.cy}; is the camera calibrated and does its "
                "camera_info carry K?"
            )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, factor: float) -> PinholeCamera:
        """The camera of an image resized by `factor` (0.5 halves each side)."""
        return PinholeCamera(
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def ray_directions(self, u: NDArray[np.number], v: NDArray[np.number]) -> NDArray[np.float32]:
        """Directions with z = 1 through pixels (u, v), shape (..., 3), camera frame."""
        x = (np.asarray(u, np.float64) - self.cx) / self.fx
        y = (np.asarray(v, np.float64) - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)

    def pixel_directions(self) -> NDArray[np.float32]:
        """Directions with z = 1 of all pixels, shape (height, width, 3), camera frame."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self.ray_directions(u, v)

    def back_project(self, depth_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Points of a depth image (H, W) [m], shape (H, W, 3), camera frame; no depth gives 0."""
        if depth_m.shape != (self.height, self.width):
            raise FrameError(
                f"depth image is {depth_m.shape[1]}x{depth_m.shape[0]}, "
                f"the camera {self.width}x{self.height}; use the intrinsics of these images"
            )
        return self.pixel_directions() * depth_m[..., None].astype(np.float32)

    def project(
        self, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
        """Project points (N, 3) [m, camera frame] to (u, v, z); u and v are NaN where z <= 0."""
        z = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(z > 0, 1.0 / z, np.nan)
        return (
            points[:, 0] * inverse * self.fx + self.cx,
            (points[:, 1] * inverse * self.fy + self.cy),
            z,
        )

    def to_dict(self) -> dict[str, float]:
        """Plain numbers, as in a `camera.json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, path: Path) -> PinholeCamera:
        """Read a `camera.json` with width, height, fx, fy, cx, cy.

        Raises:
            FrameError: when the file is unreadable, a key is missing or a value is unusable.
        """
        return cls.described(path)[0]

    @classmethod
    def described(cls, path: Path) -> tuple[PinholeCamera, dict[str, Any]]:
        """The camera of a `camera.json`, and everything the file says; raises as `from_json`."""
        try:
            values = json.loads(read_file(path, MAX_DESCRIPTION_BYTES))
            camera = cls(
                width=int(values["width"]),
                height=int(values["height"]),
                **{key: float(values[key]) for key in ("fx", "fy", "cx", "cy")},
            )
        except FrameError as error:
            raise FrameError(f"{path}: {error}") from error
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            raise FrameError(
                f"{path} is not a camera description ({error!r}); "
                "expected JSON with width, height, fx, fy, cx, cy"
            ) from error
        return camera, values


def register_depth_to_color(
    depth_m: NDArray[np.float32],
    depth_camera: PinholeCamera,
    color_camera: PinholeCamera,
    T_color_depth: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Warp a depth image into the colour camera with a z-buffer.

    Args:
        depth_m: (h, w) depth in the depth camera [m], 0 where unknown.
        depth_camera, color_camera: intrinsics of both.
        T_color_depth: (4, 4) maps depth-camera coordinates to colour-camera coordinates [m].

    Returns:
        (H, W) float32 depth in the colour camera [m], 0 where nothing projects.

    Raises:
        FrameError: when the focal lengths are of cameras that cannot belong together.
    """
    # A pixel of a coarser depth image covers several of a finer colour image.
    half_u = 0.5 * color_camera.fx / depth_camera.fx
    half_v = 0.5 * color_camera.fy / depth_camera.fy
    if max(half_u, half_v) > 0.5 * MAX_COARSENESS:
        raise FrameError(
            f"focal lengths of {color_camera.fx:g} x {color_camera.fy:g} px for colour and "
            f"{depth_camera.fx:g} x {depth_camera.fy:g} px for depth do not belong together; "
            "check both camera_info"
        )
    rotation = np.asarray(T_color_depth, np.float32)[:3, :3]
    translation = np.asarray(T_color_depth, np.float32)[:3, 3]
    # Rays are a sum of a row's and a column's part: no (h, w, 3) array is needed.
    columns = (np.arange(depth_camera.width) - depth_camera.cx) / depth_camera.fx
    rows = (np.arange(depth_camera.height) - depth_camera.cy) / depth_camera.fy
    x, y, z = (
        depth_m * (axis[0] * columns + (axis[1] * rows + axis[2])[:, None]).astype(np.float32)
        + offset
        for axis, offset in zip(rotation, translation, strict=True)
    )
    seen = (depth_m > 0) & (z > 0)
    z = z[seen]
    u = x[seen] / z * np.float32(color_camera.fx) + np.float32(color_camera.cx)
    v = y[seen] / z * np.float32(color_camera.fy) + np.float32(color_camera.cy)
    u_first = np.floor(u - np.float32(half_u - 1)).astype(np.int32)
    v_first = np.floor(v - np.float32(half_v - 1)).astype(np.int32)
    registered = np.full(color_camera.width * color_camera.height, np.inf, np.float32)
    for step_v in range(int(np.ceil(2 * half_v))):
        for step_u in range(int(np.ceil(2 * half_u))):
            column, row = u_first + step_u, v_first + step_v
            inside = (column >= 0) & (column < color_camera.width)
            inside &= (row >= 0) & (row < color_camera.height)
            index = row[inside] * color_camera.width + column[inside]
            np.minimum.at(registered, index, z[inside])
    registered[~np.isfinite(registered)] = 0.0
    return registered.reshape(color_camera.height, color_camera.width)
