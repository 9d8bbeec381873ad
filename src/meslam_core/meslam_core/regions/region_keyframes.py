"""The keyframes of a region: those that train it, and what they mark as observed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.regions.region import Region
from meslam_core.se3 import inverse

# A new region continues its parent's map, so that every keyframe with so many of its points in the
# box shows what the network knows already.
MIN_CONTINUED_SHARE = 0.1
# One that it meets later shows new things. From outside the box it counts where most of its points
# lie in the box and it was taken so many half-sides from the centre: what a view from farther away,
# or from the other side of a wall, shows besides would displace what the network knows of its box.
MIN_MET_SHARE = 0.5
MET_WITHIN = 2.0


class RegionKeyframes:
    """Gives regions the keyframes that see them.

    Args:
        keyframes: of all regions.
    """

    def __init__(self, keyframes: KeyframeStore) -> None:
        self._keyframes = keyframes

    def assign(
        self, region: Region, parent: Region, observed_alike: bool, in_doubt: bool = False
    ) -> None:
        """Give a new region every keyframe that sees it, or else its parent's last one.

        Args:
            region: without keyframes.
            parent: the region it begins beside.
            observed_alike: whether its mask already shows what the parent's keyframes saw.
            in_doubt: whether the path to here may have drifted. Then only the parent's keyframes
                count, of which the others may be some way off; it meets these later.
        """
        everyone = range(len(self._keyframes))
        region.keyframes = self._continued(region, parent.keyframes if in_doubt else everyone)
        region.keyframes = region.keyframes or parent.keyframes[-1:]
        region.seen = 0 if in_doubt else len(everyone)
        known = set(parent.keyframes) if observed_alike else set()
        region.unmarked = [k for k in region.keyframes if k not in known]

    def meet(self, region: Region) -> None:
        """Give a region the keyframes that saw it while it was at rest."""
        count = len(self._keyframes)
        if region.seen < count:
            known = set(region.keyframes)
            found = self._met(region, range(region.seen, count))
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

    def _continued(self, region: Region, keyframes: Iterable[int]) -> list[int]:
        """Those keyframes that were taken in a region's box or see a part of it."""
        numbers, off_center, share = self._views(region, keyframes)
        return [int(k) for k in numbers[(off_center < 1.0) | (share > MIN_CONTINUED_SHARE)]]

    def _met(self, region: Region, keyframes: Iterable[int]) -> list[int]:
        """Those keyframes that were taken in a region's box, or beside it and see little else."""
        numbers, off_center, share = self._views(region, keyframes)
        beside = (off_center < MET_WITHIN) & (share > MIN_MET_SHARE)
        return [int(k) for k in numbers[(off_center < 1.0) | beside]]

    def _views(
        self, region: Region, keyframes: Iterable[int]
    ) -> tuple[NDArray[np.int64], NDArray[np.floating], NDArray[np.floating]]:
        """Keyframes (K,), their distance to the centre along the farthest axis (K,) [half-sides],
        and the share of their points that lie in the box (K,).
        """
        numbers = np.array(list(keyframes), np.int64)
        T = inverse(region.T_map_region)
        positions = self._keyframes.pose_arrays()[1][numbers] @ T[:3, :3].T + T[:3, 3]
        points = self._keyframes.points(numbers) @ T[:3, :3].T + T[:3, 3]
        share = (np.abs(points) < region.half_side_m).all(axis=2).mean(axis=1)
        return numbers, np.abs(positions).max(axis=1) / region.half_side_m, share
