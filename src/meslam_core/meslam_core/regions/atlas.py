"""All regions: which exist, which one works, which are in training (Sec. II-C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import MeslamConfig
from meslam_core.field import make_field
from meslam_core.field.network import shifted
from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.regions.grid import RegionGrid, RegionIndex
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region

MIN_VISIBLE_SHARE = 0.1


@dataclass(frozen=True)
class RegionChange:
    """What a new pose did to the regions."""

    created: tuple[RegionIndex, ...] = ()
    woken: tuple[RegionIndex, ...] = ()
    working_changed: bool = False


class RegionAtlas:
    """Distributes networks in space and tracks which of them works.

    Args:
        config: of regions and fields.
        position: (3,) of the first camera in the map frame [m]; the first region's centre.
        keyframes: shared by all regions.
        seed: of the first network's weights.
    """

    def __init__(
        self,
        config: MeslamConfig,
        position: NDArray[np.floating],
        keyframes: KeyframeStore,
        seed: int,
    ) -> None:
        self.config = config
        self.grid = RegionGrid.around(position, config.regions)
        self.keyframes = keyframes
        self._seed = seed
        self.regions: dict[RegionIndex, Region] = {}
        self._working: RegionIndex = (0, 0, 0)
        self._training: list[RegionIndex] = []
        self.regions[self._working] = self._new_region(self._working)

    @property
    def working(self) -> Region:
        """The region that is optimised together with the pose."""
        return self.regions[self._working]

    @property
    def training(self) -> list[Region]:
        """Regions trained without influence on the pose."""
        return [self.regions[index] for index in self._training]

    @property
    def active(self) -> list[Region]:
        """The working region and those in training."""
        return [self.working, *self.training]

    def update(self, position: NDArray[np.floating]) -> RegionChange:
        """Create, wake and switch regions for a camera at `position` (3,), map frame [m]."""
        containing = self.grid.containing(position)
        created = [index for index in containing if index not in self.regions]
        before = set(self._training)
        for index in created:
            self.regions[index] = self._inherited(index)
        changed = False
        past = self.grid.distance_past_middle(position, self._working)
        if past > self.config.regions.hysteresis_m:
            nearest = self.grid.nearest(position)
            if nearest not in self.regions:
                self.regions[nearest] = self._inherited(nearest)
                created.append(nearest)
            self._working, changed = nearest, True
        self._training = [index for index in containing if index != self._working]
        woken = tuple(i for i in self._training if i not in before and i not in created)
        return RegionChange(tuple(created), woken, changed)

    def add_keyframe(self, keyframe: int) -> None:
        """Give a new keyframe to every active region and mark what it observed."""
        for region in self.active:
            region.keyframes.append(keyframe)
            self.observe(region, keyframe)

    def observe(self, region: Region, keyframe: int) -> None:
        """Mark in a region's mask what a keyframe saw."""
        rays = self.keyframes.all_rays(keyframe)
        rotation = self.keyframes.rotations[keyframe]
        origin = self.keyframes.translations[keyframe].cpu().numpy().astype(np.float64)
        directions = (rays.directions @ rotation.T).cpu().numpy()
        axes = region.T_map_region[:3, :3]
        region.mask.integrate(
            (origin - region.T_map_region[:3, 3]) @ axes,
            directions @ axes,
            rays.distances_m.cpu().numpy(),
            region.field.config.truncation_m,
        )

    def rebuild_masks(self) -> None:
        """Mark the observed space anew from the refined keyframe poses."""
        for region in self.regions.values():
            region.mask.clear()
            for keyframe in region.keyframes:
                self.observe(region, keyframe)

    def _new_region(self, index: RegionIndex) -> Region:
        T_map_region = np.eye(4)
        T_map_region[:3, 3] = self.grid.center(index)
        half_side = 0.5 * self.grid.side_m
        extent = self.config.regions.mask_extent * half_side
        return Region(
            index=index,
            T_map_region=T_map_region,
            side_m=self.grid.side_m,
            field=make_field(self.config.field, self._seed),
            mask=ObservedMask(extent, self.config.regions.mask_voxel_m),
        )

    def _inherited(self, index: RegionIndex) -> Region:
        """A new region that continues the working region's map exactly, and its replay."""
        parent, region = self.working, self._new_region(index)
        offset = (region.T_map_region - parent.T_map_region)[:3, 3] / parent.half_side_m
        region.field.load_flat(shifted(parent.field.flat(), self.config.field.embedding, offset))
        region.keyframes = [k for k in parent.keyframes if self._sees(region, k)]
        region.keyframes = region.keyframes or parent.keyframes[-1:]
        for keyframe in region.keyframes:
            self.observe(region, keyframe)
        return region

    def _sees(self, region: Region, keyframe: int) -> bool:
        """Whether a keyframe was taken in a region's box or sees a good part of it."""
        center = torch.from_numpy(region.T_map_region[:3, 3]).float()
        position = self.keyframes.translations[keyframe].cpu()
        if bool(((position - center).abs() < region.half_side_m).all()):
            return True
        rays = self.keyframes.all_rays(keyframe).to(torch.device("cpu"))
        rotation = self.keyframes.rotations[keyframe].cpu()
        ends = position + (rays.directions * rays.distances_m[:, None]) @ rotation.T
        inside = ((ends - center).abs() < region.half_side_m).all(dim=1)
        return float(inside.float().mean()) > MIN_VISIBLE_SHARE
