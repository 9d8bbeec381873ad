"""Links between keyframes that see the same: what keeps a long path in place.

Odometry ties each keyframe to the one before; errors add up along the way. A keyframe that sees
again what an older one saw is registered with it directly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from meslam_core.camera import PinholeCamera
from meslam_core.config import KeyframesConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry.registration import Registrar
from meslam_core.se3 import Pose, inverse, rotation_angle

# Points of the new keyframe by which an overlap is judged.
JUDGED_POINTS = 64
MIN_OVERLAP = 0.5
MIN_FITNESS = 0.7
MIN_AGREEMENT = 0.45
# A registration farther from where the keyframes are believed to be is not believed itself.
MAX_CORRECTION_M = 0.15
MAX_CORRECTION_RAD = 0.12


@dataclass(frozen=True)
class CovisibilityLink:
    """A measured motion: keyframe `second`'s camera coordinates to `first`'s.

    Attributes:
        first, second: numbers of the keyframes.
        T_first_second: (4, 4).
    """

    first: int
    second: int
    T_first_second: Pose


class CovisibilityLinker:
    """Registers new keyframes with older ones whose view they share.

    Args:
        keyframes: whose poses tell what overlaps.
        registrar: of the odometry.
        config: number of links a keyframe, and of keyframes whose images are kept.
    """

    def __init__(
        self, keyframes: KeyframeStore, registrar: Registrar, config: KeyframesConfig
    ) -> None:
        self._keyframes = keyframes
        self._registrar = registrar
        self._config = config
        self._frames: dict[int, RgbdFrame] = {}
        self._camera: PinholeCamera | None = None

    def link(self, keyframe: int, frame: RgbdFrame, rays: Rays) -> list[CovisibilityLink]:
        """Register a new keyframe with up to `config.links` older ones.

        Args:
            keyframe: number of the new one.
            frame: its images; they are kept for keyframes to come.
            rays: its sample, camera frame.
        """
        links: list[CovisibilityLink] = []
        prepared = self._registrar.prepare(frame)
        for older in self._candidates(keyframe, frame.camera, rays):
            if len(links) >= self._config.links:
                break
            T_older_new = self._register(older, keyframe, prepared)
            if T_older_new is not None:
                links.append(CovisibilityLink(older, keyframe, T_older_new))
        self._frames[keyframe] = frame
        return links

    def _register(self, older: int, keyframe: int, prepared: object) -> Pose | None:
        """T_older_new (4, 4) where the two fit; None where not."""
        guess = inverse(self._keyframes.pose(older)) @ self._keyframes.pose(keyframe)
        target = self._registrar.prepare(self._frames[older])
        try:
            found = self._registrar.register(prepared, target, guess)
        except RuntimeError:
            return None
        if found.fitness < MIN_FITNESS or found.agreement < MIN_AGREEMENT:
            return None
        correction = inverse(guess) @ found.T_target_source
        far = float(np.linalg.norm(correction[:3, 3])) > MAX_CORRECTION_M
        turned = rotation_angle(correction) > MAX_CORRECTION_RAD
        return None if far or turned else found.T_target_source

    def _candidates(self, keyframe: int, camera: PinholeCamera, rays: Rays) -> Iterator[int]:
        """Older keyframes that share the view, the oldest and the nearest in turn."""
        pose = self._keyframes.pose(keyframe)
        step = max(1, len(rays) // JUDGED_POINTS)
        points = (rays.directions[::step] * rays.distances_m[::step, None]).numpy()
        points = points @ pose[:3, :3].T + pose[:3, 3]
        # The one before is tied by odometry.
        numbers = np.array([n for n in self._frames if n < keyframe - 1], np.int64)
        if not len(numbers):
            return
        rotations, translations = self._keyframes.pose_arrays()
        moved = points[None] - translations[numbers, None]
        moved = np.einsum("kji,knj->kni", rotations[numbers], moved)
        u, v, z = camera.project(moved.reshape(-1, 3))
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        overlap = inside.reshape(len(numbers), -1).mean(axis=1)
        seen = numbers[overlap > MIN_OVERLAP]
        best = numbers[np.argsort(-overlap, kind="stable")]
        best = best[np.isin(best, seen)]
        oldest = seen[np.argsort(seen)]
        given: set[int] = set()
        for pair in zip(oldest, best, strict=True):
            for number in pair:
                if int(number) not in given:
                    given.add(int(number))
                    yield int(number)
