"""The lattice of overlapping region boxes (Sec. II-C)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import RegionsConfig

RegionIndex = tuple[int, int, int]

MAX_REGIONS = 100_000
"""Of a map, however it comes: far more than anybody walks through, and few enough to list."""


@dataclass(frozen=True)
class RegionGrid:
    """Cubes of fixed volume on a lattice aligned with the map frame.

    Attributes:
        origin: (3,) centre of region (0, 0, 0) in the map frame [m].
        side_m: length of a cube's side [m].
        overlap: share of the side that neighbours have in common.
    """

    origin: NDArray[np.float64]
    side_m: float
    overlap: float

    @classmethod
    def around(cls, position: NDArray[np.floating], config: RegionsConfig) -> RegionGrid:
        """The lattice whose first region is centred on `position` (3,), map frame [m]."""
        side = config.volume_m3 ** (1.0 / 3.0)
        return cls(np.array(position, np.float64), side, config.overlap)

    @property
    def spacing_m(self) -> float:
        """Distance of neighbouring centres [m]."""
        return self.side_m * (1.0 - self.overlap)

    def center(self, index: RegionIndex) -> NDArray[np.float64]:
        """Centre (3,) of a region in the map frame [m]."""
        return self.origin + self.spacing_m * np.asarray(index, np.float64)

    def nearest(self, position: NDArray[np.floating]) -> RegionIndex:
        """The region whose centre is nearest; between two regions the middle decides."""
        steps = np.rint((np.asarray(position) - self.origin) / self.spacing_m).astype(int)
        return (int(steps[0]), int(steps[1]), int(steps[2]))

    def containing(
        self, position: NDArray[np.floating], margin_m: float = 0.0
    ) -> list[RegionIndex]:
        """All regions whose box contains a position: one, or up to eight in intersections.

        Args:
            position: (3,) [m].
            margin_m: by so much the boxes are taken larger on all sides [m].
        """
        relative = (np.asarray(position, np.float64) - self.origin) / self.spacing_m
        reach = (0.5 * self.side_m + margin_m) / self.spacing_m
        candidates = [
            range(int(np.ceil(value - reach)), int(np.floor(value + reach)) + 1)
            for value in relative
        ]
        return [(i, j, k) for i, j, k in product(*candidates)]

    def distance_past_middle(self, position: NDArray[np.floating], working: RegionIndex) -> float:
        """How far [m] a position lies past the middle of the working region's intersections.

        Negative inside the part that is nearer to the working region than to any neighbour.
        """
        offset = np.abs(np.asarray(position) - self.center(working)).max()
        return float(offset - 0.5 * self.spacing_m)
