"""The random choice of rays for several training steps at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MappingConfig

MIN_LOSS = 1e-4
# More keyframes than this do not take part at once, so that a step's work stays bounded.
MOST_KEYFRAMES = 256

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class RayDraws:
    """Which rays T steps train on: R of keyframes and C of the current frame each.

    Attributes:
        keyframes: (A,) numbers of the keyframes that take part, ascending.
        chosen: (T, R) each ray's keyframe, as an index into `keyframes`.
        slots: (T, R) its number among the keyframe's rays.
        current_slots: (T, C) numbers of rays of the current frame.
        seeds: (T,) for what a step draws itself.
    """

    keyframes: Integers
    chosen: Integers
    slots: Integers
    current_slots: Integers
    seeds: Integers

    def __len__(self) -> int:
        return len(self.seeds)


def draw_rays(
    generator: np.random.Generator,
    config: MappingConfig,
    steps: int,
    members: Integers,
    losses: NDArray[np.float32],
    rays_per_keyframe: int,
    current_rays: int,
) -> RayDraws:
    """Rays by the root of their keyframe's loss; beside a current frame some of the latest one.

    Args:
        generator: of every choice.
        config: numbers of rays.
        steps: T.
        members: (K,) keyframe numbers, the latest last.
        losses: (K,) running losses of the members.
        rays_per_keyframe: number of rays that a keyframe has.
        current_rays: number of rays that the current frame has; 0 leaves it out.
    """
    weights = np.sqrt(np.maximum(losses, MIN_LOSS).astype(np.float64))
    latest_number = members[-1]
    if len(members) > MOST_KEYFRAMES:
        members, weights = _representatives(generator, members, weights)
    order = np.argsort(members)
    keyframes, weights = members[order], weights[order]
    # The latest keyframe stands for where the camera is: nowhere, when no frame is current.
    latest = round(config.rays * config.latest_share) if current_rays else 0
    chosen = np.empty((steps, config.rays), np.int64)
    ladder = np.cumsum(weights)
    heights = generator.random((steps, config.rays - latest)) * ladder[-1]
    drawn = np.searchsorted(ladder, heights, side="right")
    chosen[:, : config.rays - latest] = np.minimum(drawn, len(keyframes) - 1)
    chosen[:, config.rays - latest :] = np.searchsorted(keyframes, latest_number)
    of_current = config.current_rays if current_rays else 0
    return RayDraws(
        keyframes=keyframes,
        chosen=chosen,
        slots=generator.integers(rays_per_keyframe, size=chosen.shape),
        current_slots=generator.integers(max(current_rays, 1), size=(steps, of_current)),
        seeds=generator.integers(2**31, size=steps),
    )


def _representatives(
    generator: np.random.Generator, members: Integers, weights: NDArray[np.float64]
) -> tuple[Integers, NDArray[np.float64]]:
    """Some of many keyframes, among them the latest, with weights.

    By systematic resampling: over many draws a ray of each keyframe comes as often as if all had
    taken part.
    """
    count = MOST_KEYFRAMES - 1
    ladder = np.cumsum(weights)
    heights = (np.arange(count) + generator.random()) * (ladder[-1] / count)
    rows = np.minimum(np.searchsorted(ladder, heights, side="right"), len(members) - 1)
    times = np.bincount(rows, minlength=len(members)).astype(np.float64)
    taken = times > 0
    taken[-1] = True
    return members[taken], times[taken]
