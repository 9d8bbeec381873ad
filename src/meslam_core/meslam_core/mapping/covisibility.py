"""Links between keyframes that see the same: what keeps a long path in place.

Odometry ties each keyframe to the one before; errors add up along the way. A keyframe that sees
again what an older one saw is registered with it directly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframe_images import KeyframeImage, KeyframeImages
from meslam_core.mapping.keyframe_links import MeasuredMotion
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry import Registration, make_registrar
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, inverse, rotation_angle

# Points of the new keyframe by which an overlap is judged.
JUDGED_POINTS = 64
MIN_OVERLAP = 0.5
ATTEMPTS_A_LINK = 2
# So many older keyframes stay ready: the next keyframe is mostly linked to the same ones.
READY_KEYFRAMES = 8
MIN_FITNESS = 0.6
MIN_AGREEMENT = 0.3
# A registration farther from where the keyframes are believed to be is not believed itself.
MAX_CORRECTION_M = 0.3
MAX_CORRECTION_RAD = 0.25
# A place is recognised when so many older keyframes say the same of where the camera is; these
# share at least this much of the view, as far as the believed pose tells.
RECOGNISING = 2
RECOGNITION_ATTEMPTS = 4
MIN_RECOGNISED_OVERLAP = 0.3
# They may share little of the view; where they meet, nearly all of it then has to look alike.
MIN_RECOGNISED_FITNESS = 0.3
# Recognised poses that agree within this are the same [m, rad].
SAME_PLACE_M = 0.05
SAME_PLACE_RAD = 0.02


class CovisibilityLinker:
    """Registers new keyframes with older ones whose view they share.

    Args:
        keyframes: whose poses tell what overlaps.
        config: number of links a keyframe, and of the registration.
        scratch: where the keyframes' images lie.
    """

    def __init__(
        self, keyframes: KeyframeStore, config: MeslamConfig, scratch: ScratchFile
    ) -> None:
        self._keyframes = keyframes
        self._links = config.keyframes.links
        self._width = config.odometry.image_width
        # Errors of single images average out over many links; the depth camera's own, which
        # are alike in all, do not: here the images count in full.
        odometry = replace(config.odometry, luma_bias_m=0.0, luma_bias_deg=0.0)
        self._registrar = make_registrar(odometry, config.sensor)
        self._reach_m = config.sensor.max_depth_m
        self._images = KeyframeImages(scratch)
        self._ready = lru_cache(maxsize=READY_KEYFRAMES)(self._prepare_older)

    def keep(self, keyframe: int, frame: RgbdFrame) -> None:
        """Keep a new keyframe's images: it can be linked from now on, and to."""
        self._images.add(keyframe, self.image(frame))

    def link(
        self, keyframe: int, camera: PinholeCamera, rays: Rays
    ) -> Iterator[MeasuredMotion | None]:
        """Register a keyframe with up to `config.links` older ones, one at a time.

        Args:
            keyframe: number of one that is kept.
            camera: of its frame.
            rays: its sample, camera frame.

        Yields:
            After every registration the link that it found, or None.
        """
        prepared = self._ready(keyframe)
        links = 0
        candidates = self._candidates(keyframe, camera, rays)
        for older in islice(candidates, ATTEMPTS_A_LINK * self._links):
            if links >= self._links:
                return
            link = self._register(older, keyframe, prepared)
            links += link is not None
            yield link

    def recognise(
        self, keyframe: int, camera: PinholeCamera, rays: Rays, among: Sequence[int]
    ) -> Iterator[list[MeasuredMotion]]:
        """Where a keyframe is among older ones, however far off its pose is believed to be.

        Args:
            keyframe: number of one that is kept.
            camera: of its frame.
            rays: its sample, camera frame.
            among: older keyframes.

        Yields:
            After every registration links that agree with each other, the last of which did so;
            none while the place is not recognised for certain. Ends at once where no older
            keyframe can have seen it.
        """
        known = np.intersect1d(np.array(among, np.int64), self._images.numbers)
        overlaps = self._overlaps(keyframe, camera, rays, known)
        shared = [k for k, overlap in overlaps if overlap > MIN_RECOGNISED_OVERLAP]
        links: list[MeasuredMotion] = []
        for other in shared[:RECOGNITION_ATTEMPTS]:
            guess = inverse(self._keyframes.pose(other)) @ self._keyframes.pose(keyframe)
            found = self.find(other, self._ready(keyframe), guess)
            alike: list[MeasuredMotion] = []
            if found is not None:
                link = MeasuredMotion(other, keyframe, found.T_target_source)
                alike = [each for each in links if self._agree(each, link)]
                links.append(link)
            yield [*alike, links[-1]] if len(alike) + 1 >= RECOGNISING else []

    def image(self, frame: RgbdFrame) -> KeyframeImage:
        """What is kept of a frame that becomes a keyframe."""
        return KeyframeImage.of(frame, self._width)

    def image_of(self, keyframe: int) -> KeyframeImage:
        """What is kept of a keyframe that is kept.

        Raises:
            KeyError: it is not.
            OutputError: when the disk fails.
        """
        return self._images.get(keyframe)

    def prepare(self, image: KeyframeImage) -> Any:
        """An image made ready for `find`."""
        return self._registrar.prepare(image.frame())

    def find(self, older: int, prepared: Any, guess: Pose) -> Registration | None:
        """Where a view is in a keyframe, if a good fit tells; else None.

        Args:
            older: a keyframe that is kept.
            prepared: the view.
            guess: T_older_view (4, 4), which may be far off: features propose others.
        """
        target = self._ready(older)
        best = None
        try:
            for start in (*self._registrar.propose(prepared, target), guess):
                found = self._registrar.register(prepared, target, start)
                if best is None or found.agreement > best.agreement:
                    best = found
        except RuntimeError:
            return None
        if best is None:
            return None
        fits = best.fitness >= MIN_FITNESS and best.agreement >= MIN_AGREEMENT
        alike = best.fitness >= MIN_RECOGNISED_FITNESS and best.looks_alike
        return best if fits or alike else None

    def _prepare_older(self, number: int) -> Any:
        return self.prepare(self._images.get(number))

    def _agree(self, first: MeasuredMotion, second: MeasuredMotion) -> bool:
        """Whether two links say the same of where the new keyframe is."""
        poses = [self._keyframes.pose(k.first) @ k.T_first_second for k in (first, second)]
        apart = inverse(poses[0]) @ poses[1]
        near = float(np.linalg.norm(apart[:3, 3])) < SAME_PLACE_M
        return near and rotation_angle(apart) < SAME_PLACE_RAD

    def _register(self, older: int, keyframe: int, prepared: Any) -> MeasuredMotion | None:
        """The link of two keyframes where they fit; None where not."""
        guess = inverse(self._keyframes.pose(older)) @ self._keyframes.pose(keyframe)
        target = self._ready(older)
        try:
            found = self._registrar.register(prepared, target, guess)
        except RuntimeError:
            return None
        if found.fitness < MIN_FITNESS or found.agreement < MIN_AGREEMENT:
            return None
        correction = inverse(guess) @ found.T_target_source
        far = float(np.linalg.norm(correction[:3, 3])) > MAX_CORRECTION_M
        turned = rotation_angle(correction) > MAX_CORRECTION_RAD
        return None if far or turned else MeasuredMotion(older, keyframe, found.T_target_source)

    def _candidates(self, keyframe: int, camera: PinholeCamera, rays: Rays) -> Iterator[int]:
        """Keyframes that share the view: those that share most and the oldest in turn."""
        kept = self._images.numbers
        overlaps = self._overlaps(keyframe, camera, rays, kept[kept < keyframe])
        best = [number for number, overlap in overlaps if overlap > MIN_OVERLAP]
        given: set[int] = set()
        for two in zip(best, sorted(best), strict=True):
            for number in two:
                if number not in given:
                    given.add(number)
                    yield number

    def _overlaps(
        self, keyframe: int, camera: PinholeCamera, rays: Rays, others: NDArray[np.int64]
    ) -> list[tuple[int, float]]:
        """Older keyframes with the share of the new one's points that they see, most first."""
        pose = self._keyframes.pose(keyframe)
        step = max(1, len(rays) // JUDGED_POINTS)
        points = (rays.directions[::step] * rays.distances_m[::step, None]).numpy()
        points = points @ pose[:3, :3].T + pose[:3, 3]
        rotations, translations = self._keyframes.pose_arrays()
        # Two cameras farther apart measure no point in common.
        apart = np.linalg.norm(translations[others] - pose[:3, 3].astype(np.float32), axis=1)
        others = others[(apart < 2.0 * self._reach_m) & (others != keyframe)]
        if not len(others):
            return []
        moved = points[None] - translations[others, None]
        moved = np.einsum("kji,knj->kni", rotations[others], moved)
        u, v, z = camera.project(moved.reshape(-1, 3))
        inside = (z > 0) & (z < self._reach_m)
        inside &= (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        overlap = inside.reshape(len(others), -1).mean(axis=1)
        order = np.argsort(-overlap, kind="stable")
        return [(int(others[row]), float(overlap[row])) for row in order]
