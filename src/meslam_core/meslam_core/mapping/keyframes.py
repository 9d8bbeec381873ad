"""Keyframes: a compact sample of rays each, in growing arrays that training gathers from."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframe_links import KeyframeLinks
from meslam_core.se3 import Pose

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Rays:
    """Measured rays in the camera frame.

    Attributes:
        directions: (R, 3) float32 unit vectors.
        distances_m: (R,) float32 distance of the surface along the ray [m].
        colors: (R, 3) float32 in [0, 1].
    """

    directions: torch.Tensor
    distances_m: torch.Tensor
    colors: torch.Tensor

    def __len__(self) -> int:
        return len(self.distances_m)

    def to(self, device: torch.device) -> Rays:
        """The same rays on another device."""
        return Rays(self.directions.to(device), self.distances_m.to(device), self.colors.to(device))


def rays_at(frame: RgbdFrame, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Rays:
    """The rays through given pixels of a frame; the pixels must have depth."""
    directions = frame.camera.ray_directions(columns, rows)
    lengths = np.linalg.norm(directions, axis=1)
    return Rays(
        torch.from_numpy(directions / lengths[:, None]),
        torch.from_numpy(frame.depth_m[rows, columns] * lengths),
        torch.from_numpy(frame.color[rows, columns].astype(np.float32) / 255.0),
    )


class KeyframeStore:
    """Poses and rays of all keyframes, index-addressed.

    Every keyframe keeps the same number of rays (drawn with repetition where it has fewer), so
    that a batch over many keyframes is one gather. Poses and losses live on the CPU; the rays on
    `device`. One thread may read poses while another adds keyframes or moves them.

    Attributes:
        links: measured motions between keyframes.
        stamps_ns: of the keyframes' images.
    """

    def __init__(self, rays_per_keyframe: int, device: torch.device) -> None:
        self.rays_per_keyframe = rays_per_keyframe
        self.device = device
        self.links = KeyframeLinks()
        self.stamps_ns: list[int] = []
        self._lock = threading.Lock()
        self._capacity = 0
        self._directions = torch.empty(0, rays_per_keyframe, 3, device=device)
        self._distances = torch.empty(0, rays_per_keyframe, device=device)
        self._colors = torch.empty(0, rays_per_keyframe, 3, dtype=torch.uint8, device=device)
        self._rotations = np.zeros((0, 3, 3), np.float32)
        self._translations = np.zeros((0, 3), np.float32)
        self._losses = np.zeros(0, np.float32)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def rotations(self) -> torch.Tensor:
        """(K, 3, 3) of T_map_camera; shares the store's memory where `device` is the CPU."""
        return torch.from_numpy(self._rotations[: len(self)]).to(self.device)

    @property
    def translations(self) -> torch.Tensor:
        """(K, 3) of T_map_camera [m]; shares the store's memory where `device` is the CPU."""
        return torch.from_numpy(self._translations[: len(self)]).to(self.device)

    @property
    def losses(self) -> torch.Tensor:
        """(K,) running mean of each keyframe's training loss; shares memory as the poses do."""
        return torch.from_numpy(self._losses[: len(self)]).to(self.device)

    def pose_arrays(self) -> tuple[Floats, Floats]:
        """Rotations (K, 3, 3) and translations (K, 3) [m] of T_map_camera, the store's own."""
        return self._rotations[: len(self)], self._translations[: len(self)]

    def loss_array(self) -> Floats:
        """Running losses (K,), the store's own."""
        return self._losses[: len(self)]

    def add(
        self, stamp_ns: int, T_map_camera: Pose, rays: Rays, T_previous_this: Pose | None = None
    ) -> int:
        """Append a keyframe and return its index.

        Args:
            stamp_ns: of its image [ns].
            T_map_camera: (4, 4).
            rays: at least one, camera frame.
            T_previous_this: (4, 4) odometry from the previous keyframe, where it is valid.
        """
        index = len(self)
        if index == self._capacity:
            self._grow()
        repeat = torch.arange(self.rays_per_keyframe) % len(rays)
        self._directions[index] = rays.directions[repeat].to(self.device)
        self._distances[index] = rays.distances_m[repeat].to(self.device)
        self._colors[index] = (rays.colors[repeat] * 255.0).round().to(self.device, torch.uint8)
        self.set_pose(index, T_map_camera)
        self._losses[index] = self._losses[:index].max() if index else 1.0
        self.stamps_ns.append(stamp_ns)
        if T_previous_this is not None:
            self.add_link(index - 1, index, T_previous_this)
        return index

    def add_link(self, i: int, j: int, T_i_j: Pose, weight: float = 1.0) -> None:
        """Tie two keyframes by a measured motion, which refinement weighs against the map.

        Args:
            i, j: two different keyframes.
            T_i_j: (4, 4), keyframe j's camera coordinates to keyframe i's.
            weight: factor on `mapping.odometry_weight`.

        Raises:
            IndexError: there is no such keyframe.
            ValueError: a keyframe is tied to itself, or the motion or the weight is no number.
        """
        if not (0 <= i < len(self) and 0 <= j < len(self)):
            raise IndexError(f"a link ties keyframes {i} and {j}; there are {len(self)}")
        if i == j:
            raise ValueError(f"a link ties keyframe {i} to itself; two different ones are expected")
        if not (np.isfinite(T_i_j).all() and np.isfinite(weight) and weight >= 0.0):
            raise ValueError(
                f"the link of keyframes {i} and {j} has a motion that is not finite, or the "
                f"weight {weight}; finite numbers are expected, and a weight of at least 0"
            )
        self.links.add(i, j, T_i_j, weight)

    def _grow(self) -> None:
        self._capacity = max(16, 2 * self._capacity)
        for name in ("_directions", "_distances", "_colors"):
            old = getattr(self, name)
            new = old.new_empty((self._capacity, *old.shape[1:]))
            new[: len(old)] = old
            setattr(self, name, new)
        with self._lock:
            for name in ("_rotations", "_translations", "_losses"):
                old = getattr(self, name)
                array = np.zeros((self._capacity, *old.shape[1:]), np.float32)
                array[: len(old)] = old
                setattr(self, name, array)

    def pose(self, index: int) -> Pose:
        """T_map_camera (4, 4) of a keyframe."""
        pose = np.eye(4)
        with self._lock:
            pose[:3, :3] = self._rotations[index]
            pose[:3, 3] = self._translations[index]
        return pose

    def set_pose(self, index: int, T_map_camera: Pose) -> None:
        """Replace a keyframe's pose."""
        with self._lock:
            self._rotations[index] = T_map_camera[:3, :3]
            self._translations[index] = T_map_camera[:3, 3]

    def set_poses(
        self, keyframes: NDArray[np.int64], rotations: Floats, translations: Floats
    ) -> None:
        """Replace the poses of keyframes (A,) by rotations (A, 3, 3), translations (A, 3) [m]."""
        with self._lock:
            self._rotations[keyframes] = rotations
            self._translations[keyframes] = translations

    def rays(self, keyframes: torch.Tensor, slots: torch.Tensor) -> Rays:
        """Rays number `slots` (R,) of keyframes number `keyframes` (R,)."""
        return Rays(
            self._directions[keyframes, slots],
            self._distances[keyframes, slots],
            self._colors[keyframes, slots].float() / 255.0,
        )

    def ray_arrays(
        self, keyframes: NDArray[np.int64], slots: NDArray[np.int64]
    ) -> tuple[Floats, Floats, NDArray[np.uint8]]:
        """The same for indices of any shape; `device` must be the CPU.

        Returns:
            Directions (..., 3), distances (...) [m], and colours (..., 3) in [0, 255].
        """
        rows = keyframes * self.rays_per_keyframe + slots
        return (
            self._directions.numpy().reshape(-1, 3).take(rows, axis=0),
            self._distances.numpy().reshape(-1).take(rows),
            self._colors.numpy().reshape(-1, 3).take(rows, axis=0),
        )

    def all_rays(self, index: int) -> Rays:
        """Every ray of one keyframe."""
        return Rays(
            self._directions[index], self._distances[index], self._colors[index].float() / 255.0
        )
