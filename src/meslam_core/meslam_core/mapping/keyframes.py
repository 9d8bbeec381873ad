"""Keyframes: poses, losses and links of all, rays of those that training needs."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import KeyframesConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframe_links import KeyframeLinks
from meslam_core.mapping.ray_storage import LEAST_RAYS, Rays, RayStorage, spread_choice
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose

__all__ = ["LEAST_RAYS", "KeyframeStore", "Rays", "rays_at", "spread_choice"]

Floats = NDArray[np.float32]

# So many points of a keyframe tell what it sees.
SEEN_POINTS = 64


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

    Poses and losses live on the CPU; the rays on `device`, as `RayStorage` keeps them. One thread
    may read poses while another adds keyframes or moves them; nobody may draw or read rays while
    a keyframe is added. Poses and links, about two kilobytes a keyframe, stay in memory.

    Args:
        rays_per_keyframe: kept of a keyframe as long as the budget allows.
        device: of the rays.
        ray_budget: rays in memory of all keyframes together.
        seed: of the choice of the rays that remain.
        scratch: where keyframes of regions at rest leave their rays; None keeps all in memory.

    Attributes:
        links: measured motions between keyframes.
        stamps_ns: of the keyframes' images.
        fixed: the first so many keyframes keep their poses; they hold the map in its frame.
    """

    def __init__(
        self,
        rays_per_keyframe: int,
        device: torch.device,
        ray_budget: int = KeyframesConfig.ray_budget,
        seed: int = 0,
        scratch: ScratchFile | None = None,
    ) -> None:
        self.device = device
        self.links = KeyframeLinks()
        self.stamps_ns: list[int] = []
        self.fixed = 1
        self.storage = RayStorage(rays_per_keyframe, device, ray_budget, seed, scratch)
        self._lock = threading.Lock()
        self._rotations = np.zeros((0, 3, 3), np.float32)
        self._translations = np.zeros((0, 3), np.float32)
        self._losses = np.zeros(0, np.float32)
        # Some surface points of each keyframe, camera frame.
        self._points = np.zeros((0, SEEN_POINTS, 3), np.float32)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def rays_per_keyframe(self) -> int:
        """Rays that every keyframe in memory has now; fewer the more keyframes there are."""
        return self.storage.per_keyframe

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
        if index == len(self._losses):
            self._grow()
        self.storage.add(rays)
        some = np.arange(SEEN_POINTS) * len(rays) // SEEN_POINTS
        ends = rays.directions[some] * rays.distances_m[some, None]
        self._points[index] = ends.cpu().numpy()
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
        """Room for the poses and losses of more keyframes."""
        capacity = max(16, 2 * len(self._losses))
        with self._lock:
            for name in ("_rotations", "_translations", "_losses", "_points"):
                old = getattr(self, name)
                array = np.zeros((capacity, *old.shape[1:]), np.float32)
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

    def poses(self) -> NDArray[np.float64]:
        """T_map_camera (K, 4, 4) of all keyframes."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.pose_arrays()
        return poses

    def set_poses(
        self, keyframes: NDArray[np.int64], rotations: Floats, translations: Floats
    ) -> None:
        """Replace the poses of keyframes (A,) by rotations (A, 3, 3), translations (A, 3) [m]."""
        with self._lock:
            self._rotations[keyframes] = rotations
            self._translations[keyframes] = translations

    def points(self, keyframes: NDArray[np.int64]) -> Floats:
        """Some surface points (K, P, 3) that each of the keyframes (K,) saw, map frame [m]."""
        turned = self._points[keyframes] @ self._rotations[keyframes].transpose(0, 2, 1)
        points: Floats = turned + self._translations[keyframes, None]
        return points

    def drawable(self, keyframes: Sequence[int]) -> NDArray[np.int64]:
        """Those of some keyframes whose rays are in memory, in the same order."""
        numbers = np.array(keyframes, np.int64)
        return numbers[self.storage.in_memory(numbers)]

    def rays(self, keyframes: torch.Tensor, slots: torch.Tensor) -> Rays:
        """Rays number `slots` (R,) of keyframes number `keyframes` (R,), which are in memory."""
        rows = self.storage.rows(keyframes.cpu().numpy(), slots.cpu().numpy())
        directions, distances, colors = self.storage.rays(rows)
        return Rays(directions, distances, colors.float() / 255.0)

    def ray_arrays(
        self, keyframes: NDArray[np.int64], slots: NDArray[np.int64]
    ) -> tuple[Floats, Floats, NDArray[np.uint8]]:
        """The same for indices of any shape; `device` must be the CPU.

        Returns:
            Directions (..., 3), distances (...) [m], and colours (..., 3) in [0, 255].
        """
        return self.storage.arrays(self.storage.rows(keyframes, slots))

    def all_rays(self, index: int) -> Rays:
        """Every ray of one keyframe; the store's own or read from disk.

        Valid until a keyframe is added.
        """
        return self.storage.read(index)
