"""All regions: which exist, which one works, which are in training (Sec. II-C)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MeslamConfig
from meslam_core.loop.pose_graph import rigid_motion
from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.regions.grid import RegionGrid, RegionIndex
from meslam_core.regions.inheritance import first_region, region_beside
from meslam_core.regions.region import Region
from meslam_core.regions.region_keyframes import RegionKeyframes
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import inverse, orthonormalized

# Regions whose boxes are so near are awake, though not in training: entering costs nothing then,
# and a camera that sways at a box's border does not wake and rest it every time [m].
NEAR_M = 0.3
# A region works so many half-sides from its centre while the next one has not been recognised.
PATIENCE = 1.6
# Work that regions bring with them is spread over frames: keyframes read from disk, and views
# marked in masks, at most so many a frame.
READ_A_FRAME = 24
MARKED_A_FRAME = 2


@dataclass(frozen=True)
class RegionChange:
    """What a new pose did to the regions."""

    created: tuple[RegionIndex, ...] = ()
    woken: tuple[RegionIndex, ...] = ()
    working_changed: bool = False


class RegionAtlas:
    """Distributes networks in space and tracks which of them works.

    Regions lie on a lattice about the working one: where a correction has moved that, so have its
    neighbours that are yet to come.

    Args:
        config: of regions and fields.
        position: (3,) of the first camera in the map frame [m]; the first region's centre.
        keyframes: shared by all regions.
        seed: of the first network's weights.
        scratch: where regions rest; None keeps all in memory.
    """

    def __init__(
        self,
        config: MeslamConfig,
        position: NDArray[np.floating],
        keyframes: KeyframeStore,
        seed: int,
        scratch: ScratchFile | None = None,
    ) -> None:
        self.config = config
        self.grid = RegionGrid.around(position, config.regions)
        self.keyframes = keyframes
        self._seed = seed
        self._views = RegionKeyframes(keyframes)
        self._recognises = config.regions.close_loops and config.keyframes.links > 0
        self._scratch = scratch
        self.regions: dict[RegionIndex, Region] = {}
        self._working: RegionIndex = (0, 0, 0)
        self._training: list[RegionIndex] = []
        self._near: list[RegionIndex] = []
        self._awake: list[Region] = []
        self.regions[self._working] = first_region(self._working, self.grid, config, seed)

    def take_over(
        self, grid: RegionGrid, regions: Iterable[Region], position: NDArray[np.floating]
    ) -> None:
        """Go on with regions of an earlier session; the one nearest to `position` (3,) works."""
        self.grid = grid
        self.regions = {region.index: region for region in regions}
        self._working = self.nearest(position).index
        self._wake(self.working)

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
        if self.config.regions.single:
            return RegionChange()
        on_lattice = self._on_lattice(position)
        containing = self.grid.containing(on_lattice)
        created = [index for index in containing if index not in self.regions]
        before = set(self._training)
        for index in created:
            self.regions[index] = self._neighbour(index)
        changed = False
        if self.working.off_center_m(position) > 0.5 * self.grid.spacing_m:
            nearest = self._nearest(position, on_lattice)
            if nearest not in self.regions:
                self.regions[nearest] = self._neighbour(nearest)
                created.append(nearest)
            changed, self._working = nearest != self._working, nearest
        inside = [i for i in self._about(on_lattice) if self._off_center(i, position) < self._half]
        self._training = [index for index in inside if index != self._working]
        reach = self._half + NEAR_M
        self._near = [i for i in self._about(on_lattice) if self._off_center(i, position) < reach]
        for region in self.active:
            self._wake(region)
        woken = tuple(i for i in self._training if i not in before and i not in created)
        return RegionChange(tuple(created), woken, changed)

    def _nearest(
        self, position: NDArray[np.floating], on_lattice: NDArray[np.floating]
    ) -> RegionIndex:
        """The region that is to work for a camera past the middle of the working one's box.

        The nearest one, if it is so by enough. One that the camera has not been recognised in has
        to wait until the working region's map ends: what is trained where the camera is believed
        to be would spoil it.
        """
        working = self.working.off_center_m(position)
        others = {i: self._off_center(i, position) for i in self._about(on_lattice)}
        others.pop(self._working, None)
        waiting = []
        if working < PATIENCE * self._half:
            waiting = [i for i in others if not self.regions[i].confirmed]
        found = [(others[i], i) for i in others if i not in waiting]
        distance, nearest = min(found, default=(np.inf, self._working))
        if working > self._half and distance > self._half:
            patient = any(others[i] < self._half for i in waiting)
            return self._working if patient else self.grid.nearest(on_lattice)
        if distance < working - 2.0 * self.config.regions.hysteresis_m:
            return nearest
        return self._working

    def nearest(self, position: NDArray[np.floating]) -> Region:
        """The region whose centre a position (3,), map frame [m], is nearest to."""
        return self.regions[min(self.regions, key=lambda i: self._off_center(i, position))]

    def discard(self, since: int) -> None:
        """Train no region on the keyframes from a number on: their poses proved to be wrong."""
        for region in self.regions.values():
            # One that has no others is left as it is: nothing else tells what it is of.
            region.keyframes = [k for k in region.keyframes if k < since] or region.keyframes
            region.unmarked = [k for k in region.unmarked if k < since]

    def look_into(self, region: Region) -> None:
        """Wake a region to be asked; what was looked into before goes back to rest."""
        region.wake()
        self._rest_except([region, *self.active, *self._awake])

    def enter(self, region: Region) -> None:
        """Let a region work in which the camera has been recognised, wherever it was before."""
        self._working = region.index
        region.wake()
        region.confirmed = True

    def follow(self, position: NDArray[np.floating]) -> bool:
        """Let the nearest of the regions there are work, in a map that is not trained.

        Returns:
            Whether that is another one.
        """
        centers = {
            i: self._off_center(i, position) for i in self._about(self._on_lattice(position))
        }
        nearest = min(centers, key=centers.__getitem__, default=self._working)
        margin = 2.0 * self.config.regions.hysteresis_m
        if (
            nearest == self._working
            or centers[nearest] > self._off_center(self._working, position) - margin
        ):
            return False
        self._working = nearest
        self.working.wake()
        self._rest_except([self.working])
        return True

    def _about(self, on_lattice: NDArray[np.floating]) -> list[RegionIndex]:
        """Existing regions whose boxes may be near a position on the lattice (3,) [m]."""
        near = self.grid.containing(on_lattice, self.grid.spacing_m)
        return [index for index in near if index in self.regions]

    def _off_center(self, index: RegionIndex, position: NDArray[np.floating]) -> float:
        return self.regions[index].off_center_m(position)

    @property
    def _half(self) -> float:
        return 0.5 * self.grid.side_m

    def settle(self, marks: bool = True) -> None:
        """What an update leaves to be done beside tracking, a portion at a time.

        Regions near the camera wake, those that were left rest; the keyframes that the active ones
        train on come into memory, all others leave it; masks show what was not marked yet.

        Args:
            marks: whether masks have their turn.
        """
        kept = self.active
        for index in self._near:
            region = self.regions.get(index)
            if region is not None and all(region is not each for each in kept):
                self._wake(region)
                kept.append(region)
        self._rest_except(kept)
        self._awake = kept
        # While the path may have drifted, what was seen on other parts of it lies elsewhere.
        if not self.doubtful:
            for region in kept:
                self._views.meet(region)
        wanted = [k for region in reversed(kept) for k in region.keyframes]
        self.keyframes.storage.hold(wanted, READ_A_FRAME)
        if marks:
            self._views.mark(kept, MARKED_A_FRAME)

    @property
    def doubtful(self) -> list[Region]:
        """Regions near the camera that woke and in which it has not been recognised since."""
        return [region for region in self._awake if not region.confirmed]

    def correct(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> None:
        """Move every region with its keyframes; nothing is trained anew.

        Args:
            before, after: (K, 4, 4) T_map_camera of all keyframes.
        """
        for region in self.regions.values():
            # A map is where its first keyframes are; what came later may have been elsewhere.
            first = region.keyframes[: (len(region.keyframes) + 1) // 2]
            motion = rigid_motion(before[first], after[first])
            region.T_map_region = orthonormalized(motion @ region.T_map_region)
            region.version += 1

    @contextmanager
    def awake(self, region: Region) -> Iterator[Region]:
        """One region with all its keyframes in memory, for work that goes region by region."""
        region.wake()
        self._rest_except([region, *self.active])
        self._views.meet(region)
        self.keyframes.storage.hold(region.keyframes, len(region.keyframes))
        yield region

    def add_keyframe(self, keyframe: int) -> None:
        """Give a new keyframe to every active region and mark what it observed."""
        for region in self.active:
            if not region.confirmed and region is not self.working:
                continue
            region.keyframes.append(keyframe)
            self._views.observe(region, keyframe)

    def rebuild_mask(self, region: Region) -> bool:
        """Mark the observed space anew from the refined keyframe poses; whether it changed."""
        return self._views.rebuild_mask(region)

    def _on_lattice(self, position: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where a position (3,) would be if no correction had moved the working region [m]."""
        local = inverse(self.working.T_map_region) @ np.append(position, 1.0)
        return np.asarray(self.grid.center(self._working) + local[:3], np.float64)

    def _neighbour(self, index: RegionIndex) -> Region:
        """A new region that continues the working region's map, and its replay."""
        parent = self.working
        parent.wake()
        region = region_beside(parent, index, self.grid, self.config, self._seed)
        inherited = self.config.regions.initialisation != "random"
        self._views.assign(region, parent, observed_alike=inherited, in_doubt=bool(self.doubtful))
        return region

    def _wake(self, region: Region) -> None:
        region.wake()
        # Without images of before there is nothing to be recognised by.
        known = self._recognises and region.known_until > 0
        region.confirmed = region.confirmed or not known

    def _rest_except(self, kept: list[Region]) -> None:
        if self._scratch is None:
            return
        for region in self.regions.values():
            if not any(region is each for each in kept):
                region.rest(self._scratch, len(self.keyframes))
