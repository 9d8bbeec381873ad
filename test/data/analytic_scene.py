"""A sphere in a room, known exactly, and regions whose networks learnt it.

Run as a program it trains the network anew and stores its weights beside this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.field import make_field
from meslam_core.field.model import FieldModel
from meslam_core.field.network import shifted
from meslam_core.field.rendering import surface_level
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.regions.grid import RegionGrid
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED, ObservedMask

SIDE_M = 30.0 ** (1.0 / 3.0)
GRID = RegionGrid(np.zeros(3), SIDE_M, 0.2)
MASK_VOXEL_M = 0.08
MASK_EXTENT_M = 2.4
WEIGHTS = Path(__file__).with_name("sphere_in_room.npy")


@dataclass(frozen=True)
class SphereInRoom:
    """A ball of `radius_m` at the origin of a cubic room with walls at `wall_m`."""

    radius_m: float = 0.5
    wall_m: float = 1.4

    def distance_m(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Signed distance (N,), positive in free space, of points (N, 3) [m]."""
        ball = np.linalg.norm(points, axis=-1) - self.radius_m
        walls = self.wall_m - np.abs(points).max(axis=-1)
        return np.minimum(ball, walls)

    def color(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """RGB in [0, 1] (N, 3): the ball is red, walls have a gentle gradient."""
        ball = np.linalg.norm(points, axis=-1) < 0.5 * (self.radius_m + self.wall_m)
        wall = 0.5 + 0.25 * points / self.wall_m
        return np.where(ball[:, None], [0.9, 0.1, 0.1], wall)

    def sample(
        self, count: int, truncation_m: float, generator: np.random.Generator
    ) -> NDArray[np.float64]:
        """Points (N, 3) as a camera gives them: most near surfaces, the rest in free space."""
        free = generator.uniform(-self.wall_m, self.wall_m, (count // 4, 3))
        on_ball = generator.normal(size=(count // 4, 3))
        on_ball *= self.radius_m / np.linalg.norm(on_ball, axis=1, keepdims=True)
        on_wall = generator.uniform(-self.wall_m, self.wall_m, (count - 2 * (count // 4), 3))
        axis = generator.integers(0, 3, len(on_wall))
        side = generator.choice([-self.wall_m, self.wall_m], len(on_wall))
        on_wall[np.arange(len(on_wall)), axis] = side
        near = np.concatenate([on_ball, on_wall])
        near += generator.uniform(-1.2, 1.2, (len(near), 1)) * truncation_m * self._away(near)
        return np.concatenate([free, near])

    def _away(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Unit vectors (N, 3) across the nearest surface."""
        ball = np.linalg.norm(points, axis=-1) < 0.5 * (self.radius_m + self.wall_m)
        radial = points / np.linalg.norm(points, axis=-1, keepdims=True)
        largest = np.abs(points).argmax(axis=-1)
        normal = np.zeros_like(points)
        normal[np.arange(len(points)), largest] = np.sign(points[np.arange(len(points)), largest])
        return np.where(ball[:, None], radial, normal)

    def mask(self, truncation_m: float, center: NDArray[np.floating] | None = None) -> ObservedMask:
        """What cameras everywhere in the room observe, about `center` [m]."""
        mask = ObservedMask(MASK_EXTENT_M, MASK_VOXEL_M)
        count = mask.flags.shape[0]
        axis = (np.arange(count) + 0.5) * mask.voxel_m - mask.half_extent_m
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = self.distance_m(grid + (0.0 if center is None else center))
        margin = truncation_m + 0.5 * mask.voxel_m
        flags = np.where(distance > -margin, OBSERVED, np.uint8(0))
        flags |= np.where(np.abs(distance) < margin, OBSERVED | NEAR_SURFACE, np.uint8(0))
        mask.flags[:] = flags.reshape(mask.flags.shape)
        return mask


def trained_field(
    scene: SphereInRoom, steps: int = 500, config: FieldConfig | None = None, seed: int = 0
) -> FieldModel:
    """A field that learnt the scene about its centre from exact distances and colours."""
    field = make_field(config or FieldConfig(), seed)
    level = surface_level(field.config)
    generator = np.random.default_rng(seed)
    for step in range(steps):
        points = scene.sample(4096, field.config.truncation_m, generator)
        target = np.clip(level - scene.distance_m(points) / field.config.truncation_m, -1.0, 1.0)
        values = field.evaluate(torch.from_numpy(points / (0.5 * SIDE_M)).float())
        loss = (values[:, 0] - torch.from_numpy(target).float()).abs().mean()
        near = torch.from_numpy(np.abs(target) < 1.0)
        color = torch.from_numpy(scene.color(points)).float()
        loss = loss + (values[near, 1:] - color[near]).abs().mean()
        loss.backward()
        field.step(5e-3 * 0.1 ** (step / steps))
    return field


def stored(
    field: FieldModel,
    scene: SphereInRoom,
    index: tuple[int, int, int] = (0, 0, 0),
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    version: int = 1,
) -> StoredRegion:
    """A region about `center` whose network continues `field`, which is centred at zero."""
    T_map_region = np.eye(4)
    T_map_region[:3, 3] = center
    offset = np.asarray(center) / (0.5 * SIDE_M)
    return StoredRegion(
        index=index,
        T_map_region=T_map_region,
        side_m=SIDE_M,
        architecture=Architecture.of(field.config),
        parameters=shifted(field.flat(), field.config.embedding, offset),
        mask=scene.mask(field.config.truncation_m, np.asarray(center)),
        version=version,
        stamp_ns=1_700_000_000_123_456_789,
        keyframes=12,
    )


def learnt_field(backend: str = "auto") -> FieldModel:
    """The field that `trained_field` made once; training it anew takes too long for a test."""
    field = make_field(FieldConfig(backend=backend), 0)
    field.load_flat(np.load(WEIGHTS, allow_pickle=False))
    return field


if __name__ == "__main__":
    np.save(WEIGHTS, trained_field(SphereInRoom(), steps=4000).flat(), allow_pickle=False)
