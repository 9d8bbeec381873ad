"""How a new region's map and the camera's pose fare in the first seconds after its birth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from meslam_core.evaluation.region_error import region_error
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.stored_region import snapshot
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import NEAR_SURFACE
from meslam_core.se3 import Pose, inverse
from meslam_core.slam import Slam

AGES_S = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0)


@dataclass
class Birth:
    """A new region.

    Attributes:
        region: its place on the lattice.
        created_ns: stamp of the frame that created it [ns].
        surface: (N, 3) points of the true surface in its box that the working region had seen
            when it was created, map frame [m]: the same whatever the network begins with.
        map_errors: by the age at which it was measured [s], the median distance of those points
            to the region's own surface [m].
        switched_ns: stamp of the frame at which it became the working region; None before.
        pose_errors: by the time since then [s], the error of the motion since [m].
    """

    region: RegionIndex
    created_ns: int
    surface: NDArray[np.floating]
    map_errors: dict[float, float] = field(default_factory=dict)
    switched_ns: int | None = None
    pose_errors: dict[float, float] = field(default_factory=dict)
    T_true_first: Pose | None = None
    T_map_first: Pose | None = None


class BirthWatch:
    """Follows a run frame by frame and measures every region that it creates.

    Args:
        slam: that is run; call `follow` after every frame, while nothing trains.
        surface: (N, 3) points of the true surface, map frame [m].
        ages_s: when to measure [s].

    Attributes:
        births: so far.
    """

    def __init__(
        self, slam: Slam, surface: NDArray[np.floating], ages_s: Sequence[float] = AGES_S
    ) -> None:
        self.births: list[Birth] = []
        self._slam = slam
        self._surface = surface
        self._ages_s = ages_s
        self._known: set[RegionIndex] = set()

    def follow(self, stamp_ns: int, T_map_camera: Pose, T_true_camera: Pose) -> None:
        """Measure what is due after a frame.

        Args:
            stamp_ns: of the frame [ns].
            T_map_camera: (4, 4) its online pose.
            T_true_camera: (4, 4) its true pose, in any frame that stays the same.
        """
        atlas = self._slam.atlas
        if atlas is None:
            return
        new = [index for index in atlas.regions if index not in self._known]
        if self._known:
            self.births += [Birth(index, stamp_ns, self._seen_by_working(index)) for index in new]
        self._known.update(new)
        for birth in self.births:
            self._measure_map(birth, stamp_ns)
            if birth.switched_ns is None and atlas.working.index == birth.region:
                birth.switched_ns = stamp_ns
                birth.T_true_first, birth.T_map_first = T_true_camera, T_map_camera
            self._measure_pose(birth, stamp_ns, T_map_camera, T_true_camera)

    def _seen_by_working(self, index: RegionIndex) -> NDArray[np.floating]:
        atlas = self._slam.atlas
        assert atlas is not None
        box, working = atlas.regions[index], atlas.working
        local = (self._surface - box.T_map_region[:3, 3]) @ box.T_map_region[:3, :3]
        inside = self._surface[(np.abs(local) < box.half_side_m).all(axis=1)]
        local = (inside - working.T_map_region[:3, 3]) @ working.T_map_region[:3, :3]
        return inside[working.mask.lookup(local) & NEAR_SURFACE > 0]

    def _measure_map(self, birth: Birth, stamp_ns: int) -> None:
        age_s = (stamp_ns - birth.created_ns) * 1e-9
        atlas = self._slam.atlas
        assert atlas is not None
        for due in self._due(age_s, birth.map_errors):
            placed = PlacedRegion(snapshot(atlas.regions[birth.region], stamp_ns), "auto")
            error = region_error(placed, birth.surface, observed_only=False)
            birth.map_errors[due] = error.median_m

    def _measure_pose(
        self, birth: Birth, stamp_ns: int, T_map_camera: Pose, T_true_camera: Pose
    ) -> None:
        if birth.switched_ns is None or birth.T_map_first is None or birth.T_true_first is None:
            return
        for due in self._due((stamp_ns - birth.switched_ns) * 1e-9, birth.pose_errors):
            moved = inverse(birth.T_map_first) @ T_map_camera
            true = inverse(birth.T_true_first) @ T_true_camera
            off = inverse(true) @ moved
            birth.pose_errors[due] = float(np.linalg.norm(off[:3, 3]))

    def _due(self, age_s: float, done: dict[float, float]) -> list[float]:
        return [due for due in self._ages_s if due <= age_s + 1e-6 and due not in done]


def median_errors(
    births: Sequence[Birth], of: Callable[[Birth], dict[float, float]]
) -> dict[float, float]:
    """The median over all regions at each age; regions without points are left out."""
    ages = sorted({age for birth in births for age in of(birth)})
    return {
        age: float(np.nanmedian([of(birth)[age] for birth in births if age in of(birth)]))
        for age in ages
    }
