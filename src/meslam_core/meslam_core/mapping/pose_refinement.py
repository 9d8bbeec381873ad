"""Adam on keyframe poses, folded into them step by step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MappingConfig
from meslam_core.field.model import ADAM_BETAS, ADAM_EPSILON
from meslam_core.mapping.keyframe_links import HAT_NEGATIVE, HAT_POSITIVE, LinkBlock
from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.se3 import Pose

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]

# More links than this do not take part at once, so that a step's work stays bounded.
MOST_LINKS = 512
IDENTITY = np.eye(3, dtype=np.float32)


class PoseRefinement:
    """What Adam remembers of all keyframes from one portion of steps to the next.

    Args:
        keyframes: whose poses are refined in place. The first stays fixed: it holds the map in
            its frame.
        config: learning rate and its decay, weight of the links.
    """

    def __init__(self, keyframes: KeyframeStore, config: MappingConfig) -> None:
        self.keyframes = keyframes
        self.config = config
        self.steps = 0
        self.first_moment = np.zeros((0, 6), np.float32)
        self.second_moment = np.zeros((0, 6), np.float32)

    def start(
        self, numbers: Integers, T_map_current: Pose | None, generator: np.random.Generator
    ) -> PoseBlock:
        """Take the poses of some keyframes out of the store for a portion of steps.

        Args:
            numbers: (A,) different keyframes, the ones to move.
            T_map_current: (4, 4) pose that stands behind theirs and does not move.
            generator: of the links, where there are too many.
        """
        missing = len(self.keyframes) - len(self.first_moment)
        if missing > 0:
            zeros = np.zeros((max(missing, len(self.first_moment)), 6), np.float32)
            self.first_moment = np.concatenate([self.first_moment, zeros])
            self.second_moment = np.concatenate([self.second_moment, zeros])
        links = self.keyframes.links.among(numbers, MOST_LINKS, generator)
        return PoseBlock(self, numbers, links, T_map_current)


class PoseBlock:
    """Poses that take part in a portion of steps: `movers` first, then what stands still.

    A step turns and shifts each camera about its centre, so that the derivative is always taken
    at zero.

    Attributes:
        rotations, translations: (P, 3, 3) and (P, 3) float32 T_map_camera [m].
        movers: number of poses that move.
    """

    def __init__(
        self,
        refinement: PoseRefinement,
        numbers: Integers,
        links: LinkBlock,
        T_map_current: Pose | None,
    ) -> None:
        self._refinement = refinement
        self._numbers = numbers
        self._links = links
        self.movers = len(numbers)
        rows = np.concatenate([numbers, links.anchors])
        rotations, translations = refinement.keyframes.pose_arrays()
        more = 0 if T_map_current is None else 1
        self.rotations = np.empty((len(rows) + more, 3, 3), np.float32)
        self.translations = np.empty((len(rows) + more, 3), np.float32)
        self.rotations[: len(rows)] = rotations[rows]
        self.translations[: len(rows)] = translations[rows]
        if T_map_current is not None:
            self.rotations[-1], self.translations[-1] = T_map_current[:3, :3], T_map_current[:3, 3]
        self._first = refinement.first_moment[numbers]
        self._second = refinement.second_moment[numbers]

    def move(self, gradient: Floats) -> None:
        """One Adam step; none where the gradient (P, 6) is not finite."""
        config, movers = self._refinement.config, self.movers
        gradient = gradient[:movers]
        if not np.isfinite(gradient).all():
            return
        if config.odometry_weight > 0.0:
            self._links.add_gradient(
                self.rotations, self.translations, config.odometry_weight, gradient
            )
        gradient[self._numbers < self._refinement.keyframes.fixed] = 0.0
        beta1, beta2 = ADAM_BETAS
        self._refinement.steps += 1
        n = self._refinement.steps
        self._first *= beta1
        self._first += (1 - beta1) * gradient
        gradient *= gradient
        self._second *= beta2
        self._second += (1 - beta2) * gradient
        rate = config.pose_learning_rate / (1.0 + n / config.pose_decay_steps)
        step = np.sqrt(self._second / (1 - beta2**n))
        step += ADAM_EPSILON
        np.divide(self._first, step, out=step)
        step *= -rate / (1 - beta1**n)
        # The twist turns about the camera centre: translation and rotation move on their own.
        self.translations[:movers] += step[:, :3]
        self.rotations[:movers] = _small_rotations(step[:, 3:]) @ self.rotations[:movers]

    def finish(self) -> None:
        """Put the poses back into the store, their rotations made orthonormal again."""
        moving = np.flatnonzero(self._numbers >= self._refinement.keyframes.fixed)
        numbers = self._numbers[moving]
        self._refinement.first_moment[numbers] = self._first[moving]
        self._refinement.second_moment[numbers] = self._second[moving]
        self._refinement.keyframes.set_poses(
            numbers, _orthonormal(self.rotations[moving]), self.translations[moving]
        )


def _small_rotations(w: Floats) -> Floats:
    """Rotation matrices (A, 3, 3) of small rotation vectors (A, 3), to second order."""
    entries = np.zeros((len(w), 9), np.float32)
    entries[:, HAT_POSITIVE] = w
    entries[:, HAT_NEGATIVE] = -w
    skew = entries.reshape(-1, 3, 3)
    result: Floats = IDENTITY + skew + np.float32(0.5) * (skew @ skew)
    return result


def _orthonormal(rotations: Floats) -> Floats:
    """Rotations from nearly orthonormal matrices, by a Newton step of the polar decomposition.

    Higham, *Functions of Matrices*, Sec. 8.3 (Newton-Schulz): the error is squared.
    """
    gram = rotations.transpose(0, 2, 1) @ rotations
    result: Floats = rotations @ (np.float32(1.5) * IDENTITY - np.float32(0.5) * gram)
    return result
