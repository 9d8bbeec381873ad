"""Links between keyframes that see the same: what keeps a long path in place.

Odometry ties each keyframe to the one before; errors add up along the way. A keyframe that sees
again what an older one saw is registered with it directly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.odometry import make_registrar
from meslam_core.se3 import Pose, inverse, rotation_angle

# Points of the new keyframe by which an overlap is judged.
JUDGED_POINTS = 64
MIN_OVERLAP = 0.5
ATTEMPTS_A_LINK = 2
MIN_FITNESS = 0.6
MIN_AGREEMENT = 0.3
# A registration farther from where the keyframes are believed to be is not believed itself.
MAX_CORRECTION_M = 0.15
MAX_CORRECTION_RAD = 0.12
# Images of more keyframes are not kept: of the two most alike, the older ones go.
MAX_IMAGES = 200
# An angle of 1 rad makes views as different as this distance does [m].
RADIAN_AS_M = 1.0
# Depths that differ by more than this share lie on different surfaces.
SAME_SURFACE = 0.03
DEPTH_UNIT_M = 0.0005


@dataclass(frozen=True)
class KeyframeImage:
    """What a later registration needs of a keyframe, in little memory.

    Attributes:
        gray: (H, W) uint8.
        depth: (H, W) uint16 in units of `DEPTH_UNIT_M`.
        camera: intrinsics of this resolution.
        stamp_ns: of the image [ns].
    """

    gray: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    camera: PinholeCamera
    stamp_ns: int

    @classmethod
    def of(cls, frame: RgbdFrame, width: int) -> KeyframeImage:
        """A frame's image, halved until it is at most `width` wide."""
        gray = np.asarray(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), np.uint8)
        depth, camera = np.nan_to_num(frame.depth_m, posinf=0.0, neginf=0.0), frame.camera
        while camera.width > width and min(camera.width, camera.height) > 16:
            half = (camera.width // 2, camera.height // 2)
            even = gray[: 2 * half[1], : 2 * half[0]]
            gray = np.asarray(cv2.resize(even, half, interpolation=cv2.INTER_AREA), np.uint8)
            depth = _halved_depth(depth[: 2 * half[1], : 2 * half[0]])
            camera = PinholeCamera(
                *half,
                camera.fx / 2,
                camera.fy / 2,
                (camera.cx - 0.5) / 2,
                (camera.cy - 0.5) / 2,
            )
        units = np.clip(np.rint(depth / DEPTH_UNIT_M), 0, np.iinfo(np.uint16).max)
        return cls(gray, units.astype(np.uint16), camera, frame.stamp_ns)

    def frame(self) -> RgbdFrame:
        """The image pair, without colours."""
        color = np.ascontiguousarray(np.broadcast_to(self.gray[..., None], (*self.gray.shape, 3)))
        depth_m = self.depth * np.float32(DEPTH_UNIT_M)
        return RgbdFrame(self.stamp_ns, color, depth_m, self.camera)


def _halved_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of each 2x2 block's depths on the nearest surface; 0 where there is none."""
    height, width = depth_m.shape
    corners = depth_m.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2)
    blocks = corners.reshape(height // 2, width // 2, 4)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=2, keepdims=True)
    same = (blocks > 0) & (blocks < nearest * (1.0 + SAME_SURFACE))
    count = same.sum(axis=2)
    return np.asarray((blocks * same).sum(axis=2) / np.maximum(count, 1), np.float32)


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
        config: number of links a keyframe, and of the registration.
    """

    def __init__(self, keyframes: KeyframeStore, config: MeslamConfig) -> None:
        self._keyframes = keyframes
        self._links = config.keyframes.links
        self._width = config.odometry.image_width
        # Errors of single images average out over many links; the depth camera's own, which
        # are alike in all, do not: here the images count in full.
        odometry = replace(config.odometry, luma_bias_m=0.0, luma_bias_deg=0.0)
        self._registrar = make_registrar(odometry, config.sensor)
        self._images: dict[int, KeyframeImage] = {}

    def link(self, keyframe: int, frame: RgbdFrame, rays: Rays) -> list[CovisibilityLink]:
        """Register a new keyframe with up to `config.links` older ones.

        Args:
            keyframe: number of the new one.
            frame: its images; they are kept for keyframes to come.
            rays: its sample, camera frame.
        """
        image = KeyframeImage.of(frame, self._width)
        older = islice(
            self._candidates(keyframe, frame.camera, rays), ATTEMPTS_A_LINK * self._links
        )
        links = self._register_all(keyframe, image, older)
        self._images[keyframe] = image
        if len(self._images) > MAX_IMAGES:
            self._forget_one()
        return links

    def _register_all(
        self, keyframe: int, image: KeyframeImage, others: Iterable[int]
    ) -> list[CovisibilityLink]:
        links: list[CovisibilityLink] = []
        prepared = self._registrar.prepare(image.frame())
        for other in others:
            if len(links) >= self._links:
                break
            T_other_keyframe = self._register(other, keyframe, prepared)
            if T_other_keyframe is not None:
                links.append(CovisibilityLink(other, keyframe, T_other_keyframe))
        return links

    def _register(self, older: int, keyframe: int, prepared: object) -> Pose | None:
        """T_older_new (4, 4) where the two fit; None where not."""
        guess = inverse(self._keyframes.pose(older)) @ self._keyframes.pose(keyframe)
        target = self._registrar.prepare(self._images[older].frame())
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
        """Keyframes that share the view: those that share most and the oldest in turn."""
        pose = self._keyframes.pose(keyframe)
        step = max(1, len(rays) // JUDGED_POINTS)
        points = (rays.directions[::step] * rays.distances_m[::step, None]).numpy()
        points = points @ pose[:3, :3].T + pose[:3, 3]
        numbers = np.array(list(self._images), np.int64)
        if not len(numbers):
            return
        rotations, translations = self._keyframes.pose_arrays()
        moved = points[None] - translations[numbers, None]
        moved = np.einsum("kji,knj->kni", rotations[numbers], moved)
        u, v, z = camera.project(moved.reshape(-1, 3))
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        overlap = inside.reshape(len(numbers), -1).mean(axis=1)
        seen = numbers[overlap > MIN_OVERLAP]
        best = numbers[np.argsort(-overlap, kind="stable")][: len(seen)]
        given: set[int] = set()
        for two in zip(best, np.sort(seen), strict=True):
            for number in two:
                if int(number) not in given:
                    given.add(int(number))
                    yield int(number)

    def _forget_one(self) -> None:
        """Drop an image that another one can stand for."""
        numbers = np.sort(np.array(list(self._images), np.int64))
        rotations, translations = self._keyframes.pose_arrays()
        axes, positions = rotations[numbers, :, 2], translations[numbers]
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        apart += RADIAN_AS_M * np.linalg.norm(axes[:, None] - axes[None], axis=2)
        apart[np.tril_indices(len(numbers))] = np.inf
        older, _ = np.unravel_index(np.argmin(apart), apart.shape)
        del self._images[int(numbers[older])]
