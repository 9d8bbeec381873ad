"""Links: what odometry or covisibility measured of the motion between two keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.se3 import Pose

Floats = NDArray[np.float32]

# A measurement that disagrees by more than this [m, rad] is taken for a failure and lets go.
LINK_OUTLIER = 0.03
_NEXT, _AFTER_NEXT = np.array([1, 2, 0]), np.array([2, 0, 1])
# Where a flattened matrix holds the entries of hat(w) that are w, and those that are -w.
HAT_POSITIVE, HAT_NEGATIVE = np.array([7, 2, 3]), np.array([5, 6, 1])


@dataclass(frozen=True)
class MeasuredMotion:
    """The motion between two keyframes as something measured it.

    Attributes:
        first, second: numbers of the keyframes.
        T_first_second: (4, 4), the second's camera coordinates to the first's.
    """

    first: int
    second: int
    T_first_second: Pose


class KeyframeLinks:
    """A growing list of links between any two keyframes."""

    def __init__(self) -> None:
        self._count = 0
        self._ends = np.zeros((16, 2), np.int64)
        self._rotations = np.zeros((16, 3, 3), np.float32)
        self._translations = np.zeros((16, 3), np.float32)
        self._weights = np.zeros(16, np.float32)

    def __len__(self) -> int:
        return self._count

    def add(self, i: int, j: int, T_i_j: Pose, weight: float) -> None:
        """Append a link: keyframe j's camera coordinates to keyframe i's, (4, 4)."""
        at = self._count
        if at == len(self._weights):
            for name in ("_ends", "_rotations", "_translations", "_weights"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        self._ends[at] = i, j
        self._rotations[at] = T_i_j[:3, :3]
        self._translations[at] = T_i_j[:3, 3]
        self._weights[at] = weight
        self._count += 1

    def all(self) -> LinkBlock:
        """Every link, its ends the numbers of the keyframes."""
        ends = self._ends[: self._count]
        return LinkBlock(
            int(ends.max(initial=-1)) + 1,
            np.zeros(0, np.int64),
            ends,
            self._rotations[: self._count],
            self._translations[: self._count],
            self._weights[: self._count],
        )

    def among(
        self, keyframes: NDArray[np.int64], limit: int, generator: np.random.Generator
    ) -> LinkBlock:
        """The links that touch a set of keyframes.

        Args:
            keyframes: (A,) different numbers.
            limit: at most so many links; of more, a random choice that weighs as much as all.
            generator: of that choice.
        """
        ends = self._ends[: self._count]
        size = int(max(ends.max(initial=-1), keyframes.max(initial=-1))) + 1
        local = np.full(size, -1, np.int64)
        local[keyframes] = np.arange(len(keyframes))
        chosen = np.flatnonzero((local[ends] >= 0).any(axis=1))
        share = 1.0
        if len(chosen) > limit:
            share = limit / len(chosen)
            chosen = generator.choice(chosen, limit, replace=False)
        ends = ends[chosen]
        anchors = np.unique(ends[local[ends] < 0])
        local[anchors] = len(keyframes) + np.arange(len(anchors))
        return LinkBlock(
            len(keyframes),
            anchors,
            local[ends],
            self._rotations[chosen],
            self._translations[chosen],
            self._weights[chosen] / np.float32(share),
        )


class LinkBlock:
    """Links among poses that are numbered anew: those that move first, then `anchors`.

    Args:
        movers: how many poses move.
        anchors: (N,) keyframes at the far ends of links, which stand still.
        ends: (L, 2) of each link, new numbers.
        rotations, translations: (L, 3, 3) and (L, 3) [m] of the measured motions.
        weights: (L,).
    """

    def __init__(
        self,
        movers: int,
        anchors: NDArray[np.int64],
        ends: NDArray[np.int64],
        rotations: Floats,
        translations: Floats,
        weights: Floats,
    ) -> None:
        self.anchors = anchors
        self.ends = ends
        self.rotations = rotations
        self.translations = translations
        self.weights = weights
        self._first, self._second = np.ascontiguousarray(ends.T)
        # Every step sums over the links of each pose: their order and where each pose's begin.
        both = ends.T.reshape(-1)
        order = np.argsort(both, kind="stable")
        self._order = order[both[order] < movers]
        self._poses, self._starts = np.unique(both[self._order], return_index=True)

    def add_gradient(
        self, rotations: Floats, translations: Floats, weight: float, gradient: Floats
    ) -> None:
        """Add the gradient of half the weighted squared deviations from the links.

        Args:
            rotations, translations: (P, 3, 3) and (P, 3) [m] T_map_camera, movers and anchors.
            weight: factor on all links.
            gradient: (movers, 6) by (translation, rotation) about the camera centres, map axes;
                changed in place.
        """
        if not len(self._order):
            return
        from_first = rotations.take(self._first, axis=0)
        arms = (from_first @ self.translations[:, :, None])[:, :, 0]
        turned = from_first @ self.rotations
        turned = rotations.take(self._second, axis=0) @ turned.transpose(0, 2, 1)
        turned = turned.reshape(-1, 9)
        # Shift and turn of each link's second end against where its first end would have it.
        errors = np.empty((len(arms), 2, 3), np.float32)
        moved = errors[:, 0]
        np.subtract(translations.take(self._second, axis=0), arms, out=moved)
        moved -= translations.take(self._first, axis=0)
        np.subtract(turned.take(HAT_POSITIVE, 1), turned.take(HAT_NEGATIVE, 1), out=errors[:, 1])
        errors[:, 1] *= np.float32(0.5)
        squared = (errors * errors).sum(axis=2)
        squared *= np.float32(1.0 / LINK_OUTLIER**2)
        squared += np.float32(1.0)
        # Geman-McClure.
        errors *= (np.float32(weight) * self.weights[:, None] / (squared * squared))[:, :, None]
        parts = np.empty((2, len(arms), 6), np.float32)
        parts[1] = errors.reshape(-1, 6)
        np.negative(parts[1], out=parts[0])
        lever = arms.take(_NEXT, 1) * moved.take(_AFTER_NEXT, 1)
        lever -= arms.take(_AFTER_NEXT, 1) * moved.take(_NEXT, 1)
        parts[0, :, 3:] -= lever
        sums = np.add.reduceat(parts.reshape(-1, 6).take(self._order, axis=0), self._starts)
        gradient[self._poses] += sums
