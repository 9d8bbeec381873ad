"""A region: a box, its frame in the map, its network and what it has observed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from meslam_core.field.model import FieldModel
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.se3 import Pose, inverse


@dataclass
class Region:
    """One network and the space assigned to it.

    Attributes:
        index: place on the lattice.
        T_map_region: (4, 4); the region's origin is the box's centre [m].
        side_m: side of the box [m].
        field: the network; its input is region coordinates, [-1, 1] inside the box.
        mask: what was observed, also beyond the box.
        keyframes: numbers of the keyframes that train it, the latest last.
        version: grows with every change.
    """

    index: RegionIndex
    T_map_region: Pose
    side_m: float
    field: FieldModel
    mask: ObservedMask
    keyframes: list[int] = dataclasses.field(default_factory=list)
    version: int = 0

    @property
    def half_side_m(self) -> float:
        """Half the side of the box: the unit of region coordinates [m]."""
        return 0.5 * self.side_m

    def to_region(self, points: torch.Tensor) -> torch.Tensor:
        """Region coordinates (N, 3) of points (N, 3) in the map frame [m]; differentiable."""
        T = torch.from_numpy(inverse(self.T_map_region)).float().to(points.device)
        if self._is_translation:
            return (points + T[:3, 3]) / self.half_side_m
        return (points @ T[:3, :3].T + T[:3, 3]) / self.half_side_m

    @property
    def _is_translation(self) -> bool:
        return bool(np.array_equal(self.T_map_region[:3, :3], np.eye(3)))
