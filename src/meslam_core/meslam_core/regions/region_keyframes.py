"""The keyframes of a region: those that train it, and what they mark as observed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.regions.region import Region
from meslam_core.se3 import inverse

# A keyframe trains a region when so many of its points lie in the box.
MIN_VISIBLE_SHARE = 0.1


class RegionKeyframes:
    """Gives regions the keyframes that see them.

    Args:
        keyframes: of all regions.
    """

    def __init__(self, keyframes: KeyframeStore) -> None:
        self._keyframes = keyframes

    def assign(self, region: Region, parent: Region, observed_alike: bool) -> None:
        """Give a new region every keyframe that sees it, or else its parent's last one.

        Args:
            region: without keyframes.
            parent: the region it begins beside.
            observed_alike: whether its mask already shows what the parent's keyframes saw.
        """
        region.keyframes = self._seeing(region, range(len(self._keyframes)))
        region.keyframes = region.keyframes or parent.keyframes[-1:]
        region.seen = len(self._keyframes)
        known = set(parent.keyframes) if observed_alike else set()
        region.unmarked = [k for k in region.keyframes if k not in known]

    def meet(self, region: Region) -> None:
        """Give a region the keyframes that saw it while it was at rest."""
        count = len(self._keyframes)
        if region.seen < count:
            known = set(region.keyframes)
            found = self._seeing(region, range(region.seen, count))
            found = [k for k in found if k not in known]
            if found:
                region.unmarked += found
                region.keyframes = sorted([*region.keyframes, *found])
            region.seen = count

    def mark(self, regions: Iterable[Region], most: int) -> None:
        """Mark what keyframes saw that the regions' masks do not show yet, at most so many."""
        for region in regions:
            portion = region.unmarked[:most]
            for keyframe in portion:
                self.observe(region, keyframe)
            del region.unmarked[: len(portion)]
            most -= len(portion)

    def observe(self, region: Region, keyframe: int) -> None:
        """Mark in a region's mask what a keyframe saw."""
        rays = self._keyframes.all_rays(keyframe)
        T_region_camera = inverse(region.T_map_region) @ self._keyframes.pose(keyframe)
        directions = rays.directions.cpu().numpy() @ T_region_camera[:3, :3].T.astype(np.float32)
        region.mask.integrate(
            T_region_camera[:3, 3],
            directions,
            rays.distances_m.cpu().numpy(),
            region.field_config.truncation_m,
        )

    def rebuild_mask(self, region: Region) -> bool:
        """Mark the observed space anew from the refined keyframe poses; whether it changed."""
        before = region.mask.flags.copy()
        if region.origin is None:
            region.mask.clear()
        for keyframe in region.keyframes:
            self.observe(region, keyframe)
        region.unmarked.clear()
        return not np.array_equal(region.mask.flags, before)

    def _seeing(self, region: Region, keyframes: Iterable[int]) -> list[int]:
        """Those keyframes that were taken in a region's box or see a good part of it."""
        numbers = np.array(list(keyframes), np.int64)
        if not len(numbers):
            return []
        T = inverse(region.T_map_region)
        positions = self._keyframes.pose_arrays()[1][numbers] @ T[:3, :3].T + T[:3, 3]
        inside = (np.abs(positions) < region.half_side_m).all(axis=1)
        points = self._keyframes.points(numbers) @ T[:3, :3].T + T[:3, 3]
        seen = (np.abs(points) < region.half_side_m).all(axis=2).mean(axis=1)
        return [int(k) for k in numbers[inside | (seen > MIN_VISIBLE_SHARE)]]
