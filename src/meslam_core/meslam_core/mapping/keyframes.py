"""Keyframes: a compact sample of rays each, in growing arrays that training gathers from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose


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
    that a batch over many keyframes is one gather.

    Attributes:
        rotations: (K, 3, 3), translations: (K, 3): T_map_camera [m], on `device`.
        losses: (K,) running mean of each keyframe's training loss.
        stamps_ns: of the keyframes' images.
    """

    def __init__(self, rays_per_keyframe: int, device: torch.device) -> None:
        self.rays_per_keyframe = rays_per_keyframe
        self.device = device
        self.stamps_ns: list[int] = []
        self._capacity = 0
        self._directions = torch.empty(0, rays_per_keyframe, 3, device=device)
        self._distances = torch.empty(0, rays_per_keyframe, device=device)
        self._colors = torch.empty(0, rays_per_keyframe, 3, dtype=torch.uint8, device=device)
        self._rotations = torch.empty(0, 3, 3, device=device)
        self._translations = torch.empty(0, 3, device=device)
        self._losses = torch.empty(0, device=device)
        self._link_rotations = torch.empty(0, 3, 3, device=device)
        self._link_translations = torch.empty(0, 3, device=device)
        self._link_weights = torch.empty(0, device=device)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def rotations(self) -> torch.Tensor:
        return self._rotations[: len(self)]

    @property
    def translations(self) -> torch.Tensor:
        return self._translations[: len(self)]

    @property
    def losses(self) -> torch.Tensor:
        return self._losses[: len(self)]

    @property
    def links(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Odometry from each keyframe's predecessor: (K, 3, 3), (K, 3) [m], weights (K,)."""
        count = len(self)
        return (
            self._link_rotations[:count],
            self._link_translations[:count],
            self._link_weights[:count],
        )

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
        self.stamps_ns.append(stamp_ns)
        self.set_pose(index, T_map_camera)
        self._losses[index] = self.losses[:index].max() if index else 1.0
        if T_previous_this is not None:
            link = torch.from_numpy(T_previous_this).float().to(self.device)
            self._link_rotations[index], self._link_translations[index] = link[:3, :3], link[:3, 3]
            self._link_weights[index] = 1.0
        return index

    def _grow(self) -> None:
        self._capacity = max(16, 2 * self._capacity)
        for name in (
            "_directions",
            "_distances",
            "_colors",
            "_rotations",
            "_translations",
            "_losses",
            "_link_rotations",
            "_link_translations",
            "_link_weights",
        ):
            old = getattr(self, name)
            new = old.new_zeros((self._capacity, *old.shape[1:]))
            new[: len(old)] = old
            setattr(self, name, new)

    def pose(self, index: int) -> Pose:
        """T_map_camera (4, 4) of a keyframe."""
        pose = np.eye(4)
        pose[:3, :3] = self._rotations[index].cpu().numpy()
        pose[:3, 3] = self._translations[index].cpu().numpy()
        return pose

    def set_pose(self, index: int, T_map_camera: Pose) -> None:
        """Replace a keyframe's pose."""
        self._rotations[index] = torch.from_numpy(T_map_camera[:3, :3]).float().to(self.device)
        self._translations[index] = torch.from_numpy(T_map_camera[:3, 3]).float().to(self.device)

    def rays(self, keyframes: torch.Tensor, slots: torch.Tensor) -> Rays:
        """Rays number `slots` (R,) of keyframes number `keyframes` (R,)."""
        return Rays(
            self._directions[keyframes, slots],
            self._distances[keyframes, slots],
            self._colors[keyframes, slots].float() / 255.0,
        )

    def all_rays(self, index: int) -> Rays:
        """Every ray of one keyframe."""
        return Rays(
            self._directions[index], self._distances[index], self._colors[index].float() / 255.0
        )
