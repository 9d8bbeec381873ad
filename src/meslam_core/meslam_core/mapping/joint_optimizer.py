"""Joint optimisation of a region's network and the poses of its keyframes (Sec. II-B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import MappingConfig
from meslam_core.field.kernel import KernelField
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.pose_refinement import PoseRefinement
from meslam_core.mapping.ray_batches import CompiledBatches, RayBatches, TorchBatches
from meslam_core.mapping.ray_draws import RayDraws, draw_rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose

LOSS_MEMORY = 0.8
# So many steps are drawn and gathered at once; then the losses decide anew what comes next.
STEPS_AT_ONCE = 64


@dataclass(frozen=True)
class StepLosses:
    """Mean weighted losses of one or several steps, without unit.

    Attributes:
        distance, depth, color: of the signed distance, the rendered depth and colour.
        steps: how many steps they are of.
    """

    distance: float = 0.0
    depth: float = 0.0
    color: float = 0.0
    steps: int = 0

    @property
    def total(self) -> float:
        """Their sum."""
        return self.distance + self.depth + self.color


class JointOptimizer:
    """Trains one region at a time on keyframes and on the current frame.

    Args:
        keyframes: all keyframes; poses of those that are trained on are refined in place. The
            first stays fixed: it holds the map in its frame.
        config: numbers of rays, samples and steps, learning rates, loss weights.
        seed: of the random choice of rays and samples.
    """

    def __init__(self, keyframes: KeyframeStore, config: MappingConfig, seed: int = 0) -> None:
        self.keyframes = keyframes
        self.config = config
        self.poses = PoseRefinement(keyframes, config)
        self._generator = np.random.default_rng(seed)
        self._torch_generator = torch.Generator(device=keyframes.device).manual_seed(seed)

    def train(
        self,
        region: Region,
        steps: int,
        current: Rays | None = None,
        T_map_current: Pose | None = None,
        refine_poses: bool = True,
        rate_factor: float = 1.0,
        enough: Callable[[int], bool] = lambda done: False,
    ) -> StepLosses:
        """Run `steps` steps on a region and return their mean losses.

        Poses and losses of the keyframes change in the store after every `STEPS_AT_ONCE` steps.

        Args:
            region: whose network is trained.
            steps: number of Adam steps.
            current: rays of the current frame to mix in, with their pose; on the CPU.
            T_map_current: (4, 4) pose of the current frame, held fixed.
            refine_poses: whether keyframe poses move.
            rate_factor: of the weights' learning rate.
            enough: is asked before every step, with the number of those done, whether to end.
        """
        if T_map_current is None or not self.config.current_rays:
            current = None
        sums, done = np.zeros(3), 0
        if not len(self.keyframes.drawable(region.keyframes)):
            return StepLosses()
        while done < steps and not enough(done):
            draws = self._draw(region, min(STEPS_AT_ONCE, steps - done), current)
            batches = self._batches(region, draws, current, refine_poses)
            pose = None if current is None else T_map_current
            rate = self.config.learning_rate * rate_factor
            added, taken = self._run(
                region, draws, batches, pose, refine_poses, rate, partial(_after, enough, done)
            )
            sums += added
            done += taken
        distance, depth, color = (sums / max(done, 1)).tolist()
        return StepLosses(distance, depth, color, done)

    def _run(
        self,
        region: Region,
        draws: RayDraws,
        batches: RayBatches,
        T_map_current: Pose | None,
        refine_poses: bool,
        learning_rate: float,
        enough: Callable[[int], bool],
    ) -> tuple[NDArray[np.float64], int]:
        """Take the steps that were drawn; the sum (3,) of their mean losses, and their number."""
        poses = self.poses.start(draws.keyframes, T_map_current, self._generator)
        sums = np.zeros(3)
        remembered = np.empty(draws.chosen.shape, np.float32)
        taken = 0
        for number in range(len(draws)):
            if enough(number):
                break
            losses, gradient = batches.train(number, poses.rotations, poses.translations)
            if region.field.step(learning_rate) and refine_poses:
                poses.move(gradient)
            sums += losses.mean(axis=0)
            losses[: draws.chosen.shape[1]].sum(axis=1, out=remembered[number])
            taken += 1
        if refine_poses:
            poses.finish()
        self._remember(draws.chosen[:taken], draws.keyframes, remembered[:taken])
        return sums, taken

    def _draw(self, region: Region, steps: int, current: Rays | None) -> RayDraws:
        members = self.keyframes.drawable(region.keyframes)
        return draw_rays(
            self._generator,
            self.config,
            steps,
            members,
            self.keyframes.loss_array()[members],
            self.keyframes.rays_per_keyframe,
            0 if current is None else len(current),
        )

    def _batches(
        self, region: Region, draws: RayDraws, current: Rays | None, refine_poses: bool
    ) -> RayBatches:
        if isinstance(region.field, KernelField):
            return CompiledBatches(
                region.field, region, self.keyframes, draws, current, self.config
            )
        return TorchBatches(
            region,
            self.keyframes,
            draws,
            current,
            self.config,
            self._torch_generator,
            refine_poses,
        )

    def _remember(
        self,
        chosen: NDArray[np.int64],
        keyframes: NDArray[np.int64],
        losses: NDArray[np.float32],
    ) -> None:
        """Update the running loss of `keyframes` (A,) by losses (T, R) of the `chosen` ones."""
        shape = len(chosen), len(keyframes)
        cells = (chosen + shape[1] * np.arange(shape[0])[:, None]).reshape(-1)
        counts = np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)
        sums = np.bincount(chosen.reshape(-1), losses.reshape(-1), minlength=shape[1])
        rays = counts.sum(axis=0)
        seen = (rays > 0) & np.isfinite(sums)
        # As if the mean had come again in every step that the keyframe took part in.
        memory = LOSS_MEMORY ** np.count_nonzero(counts, axis=0)[seen]
        numbers = keyframes[seen]
        running = self.keyframes.loss_array()
        running[numbers] = memory * running[numbers] + (1 - memory) * (sums[seen] / rays[seen])


def _after(enough: Callable[[int], bool], done: int, more: int) -> bool:
    return enough(done + more)
