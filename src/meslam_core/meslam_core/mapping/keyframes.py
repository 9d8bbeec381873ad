"""Keyframes: a compact sample of rays each, in arrays that training gathers from."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import KeyframesConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframe_links import KeyframeLinks
from meslam_core.se3 import Pose

Floats = NDArray[np.float32]

# Fewer rays do not show what a keyframe saw; no keyframe is thinned further than this.
LEAST_RAYS = 256
# Beyond the budget the storage grows by this share of it at a time.
CHUNK_SHARE = 0.25


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


def spread_choice(count: int, kept: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """`kept` <= `count` different numbers below `count`, ascending.

    One at random of each of `kept` equal stretches: of pixels in raster order the choice covers
    the image as evenly as they do.
    """
    edges = np.arange(kept + 1) * count // kept
    return edges[:-1] + generator.integers(np.diff(edges))


class KeyframeStore:
    """Poses and rays of all keyframes, index-addressed.

    Every keyframe keeps the same number of rays (repeated where it has fewer), so that a batch
    over many keyframes is one gather. Poses and losses live on the CPU; the rays on `device`. One
    thread may read poses while another adds keyframes or moves them; nobody may draw or read rays
    while a keyframe is added.

    Memory stays bounded: at most `ray_budget` rays are stored, 19 bytes each. Where a further
    keyframe would exceed it, the number of rays of every keyframe, old or new, is halved; a random
    half remains, spread over the image. No keyframe is thinned below `LEAST_RAYS`: with more than
    `ray_budget / LEAST_RAYS` keyframes the storage grows after all, in chunks of `CHUNK_SHARE` of
    the budget. Poses and links, about a hundred bytes each, are not counted.

    Args:
        rays_per_keyframe: kept of a keyframe as long as the budget allows.
        device: of the rays.
        ray_budget: rays of all keyframes together.
        seed: of the choice of the rays that remain.

    Attributes:
        rays_per_keyframe: the number that every keyframe has now; it falls as the store grows.
        links: measured motions between keyframes.
        stamps_ns: of the keyframes' images.
    """

    def __init__(
        self,
        rays_per_keyframe: int,
        device: torch.device,
        ray_budget: int = KeyframesConfig.ray_budget,
        seed: int = 0,
    ) -> None:
        self.rays_per_keyframe = rays_per_keyframe
        self.device = device
        self.ray_budget = ray_budget
        self.links = KeyframeLinks()
        self.stamps_ns: list[int] = []
        self._lock = threading.Lock()
        self._generator = np.random.default_rng(seed)
        # Ray s of keyframe k stands in row k * rays_per_keyframe + s.
        self._directions = torch.empty(0, 3, device=device)
        self._distances = torch.empty(0, device=device)
        self._colors = torch.empty(0, 3, dtype=torch.uint8, device=device)
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
        if index == len(self._losses):
            self._grow()
        self._make_room(index + 1)
        self._put(index, rays)
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
            for name in ("_rotations", "_translations", "_losses"):
                old = getattr(self, name)
                array = np.zeros((capacity, *old.shape[1:]), np.float32)
                array[: len(old)] = old
                setattr(self, name, array)

    def _make_room(self, keyframes: int) -> None:
        """Room for the rays of so many keyframes, by fewer rays of each or by more storage."""
        budget = self.ray_budget
        while keyframes * self.rays_per_keyframe > budget and self.rays_per_keyframe > LEAST_RAYS:
            self._thin(max(self.rays_per_keyframe // 2, LEAST_RAYS))
        wanted, stored = keyframes * self.rays_per_keyframe, len(self._distances)
        if wanted <= stored:
            return
        if wanted > budget:
            self._enlarge(wanted + int(CHUNK_SHARE * budget))
        elif self.device.type == "cpu":
            # Memory that was never touched costs nothing there.
            self._enlarge(budget)
        else:
            self._enlarge(min(max(16 * self.rays_per_keyframe, 2 * stored, wanted), budget))

    def _enlarge(self, capacity: int) -> None:
        for name in ("_directions", "_distances", "_colors"):
            old = getattr(self, name)
            used = len(self) * self.rays_per_keyframe
            new = old.new_empty((capacity, *old.shape[1:]))
            new[:used] = old[:used]
            setattr(self, name, new)

    def _thin(self, kept: int) -> None:
        """Keep so many rays of every keyframe, in place."""
        before = self.rays_per_keyframe
        for index in range(len(self)):
            slots = torch.from_numpy(spread_choice(before, kept, self._generator)).to(self.device)
            for rays in (self._directions, self._distances, self._colors):
                # What is overwritten belonged to this keyframe or to one that has moved already.
                row = rays[index * before : (index + 1) * before]
                rays[index * kept : (index + 1) * kept] = row[slots]
        self.rays_per_keyframe = kept

    def _put(self, index: int, rays: Rays) -> None:
        kept = self.rays_per_keyframe
        if len(rays) > kept:
            chosen = spread_choice(len(rays), kept, self._generator)
        else:
            chosen = np.arange(kept) % len(rays)
        slots = torch.from_numpy(chosen)
        row = self._row(index)
        self._directions[row] = rays.directions[slots].to(self.device)
        self._distances[row] = rays.distances_m[slots].to(self.device)
        self._colors[row] = (rays.colors[slots] * 255.0).round().to(self.device, torch.uint8)

    def _row(self, index: int) -> slice:
        """Where a keyframe's rays are stored."""
        return slice(index * self.rays_per_keyframe, (index + 1) * self.rays_per_keyframe)

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
        rows = keyframes * self.rays_per_keyframe + slots
        return Rays(
            self._directions[rows], self._distances[rows], self._colors[rows].float() / 255.0
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
            self._directions.numpy().take(rows, axis=0),
            self._distances.numpy().take(rows),
            self._colors.numpy().take(rows, axis=0),
        )

    def all_rays(self, index: int) -> Rays:
        """Every ray of one keyframe, the store's own: valid until a keyframe is added."""
        row = self._row(index)
        return Rays(self._directions[row], self._distances[row], self._colors[row].float() / 255.0)
