"""Refinement: training on what was seen, over all regions, when no frame has to be tracked."""

from __future__ import annotations

import math

from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region

# A refinement comes in portions of so many steps, the last at this share of the learning rate.
REFINING_STEPS = 50
LAST_RATE_FACTOR = 0.05
# Of several regions each is refined so long before it is the next one's turn, on average.
TURN_STEPS = 400


class Refinement:
    """Refines the regions of this session in turn: all but those that an earlier one left.

    No training may run meanwhile.

    Args:
        atlas: all regions.
        optimizer: trains them, and moves the keyframes.
    """

    def __init__(self, atlas: RegionAtlas, optimizer: JointOptimizer) -> None:
        self._atlas = atlas
        self._optimizer = optimizer
        # Whose turn it is, in the order of the regions' creation, and its steps yet to come.
        self._turn = -1
        self._left = 0

    @property
    def steps(self) -> int:
        """How many steps a refinement of the whole map takes.

        More than of a single region, but not in proportion: each of many was shorter in view, and
        its neighbours refine the same keyframes.
        """
        iterations = self._optimizer.config.final_iterations
        return round(iterations * math.sqrt(max(len(self._regions()), 1)))

    def train(self, steps: int, progress: float = 0.0) -> None:
        """Train for `steps` steps, over all regions; keyframe poses follow.

        Args:
            steps: number of Adam steps.
            progress: share of the whole refinement that is done, in [0, 1]; the learning rate
                falls with it, and with it the noise that training leaves in the map.
        """
        if not self._regions():
            return
        rate_factor = 1.0 + progress * (LAST_RATE_FACTOR - 1.0)
        while steps > 0:
            region, portion = self._next(steps)
            with self._atlas.awake(region):
                self._optimizer.train(region, portion, rate_factor=rate_factor)
            region.version += 1
            steps -= portion

    def rebuild_masks(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        for region in self._regions():
            with self._atlas.awake(region):
                region.version += self._atlas.rebuild_mask(region)

    def _next(self, most: int) -> tuple[Region, int]:
        """The region whose turn it is, and at most so many steps of those that it gets.

        In one round every region gets steps in proportion to its keyframes, all at once: waking
        it costs as much as some of them.
        """
        regions = self._regions()
        if self._left <= 0:
            self._turn = (self._turn + 1) % len(regions)
            mean = sum(len(each.keyframes) for each in regions) / len(regions)
            share = len(regions[self._turn].keyframes) / max(mean, 1.0)
            turn = REFINING_STEPS if len(regions) == 1 else TURN_STEPS
            self._left = max(1, round(turn * share))
        portion = min(most, self._left)
        self._left -= portion
        return regions[self._turn % len(regions)], portion

    def _regions(self) -> list[Region]:
        return [region for region in self._atlas.regions.values() if not region.untouched]
