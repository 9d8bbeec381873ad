"""Which keyframes look like a view: a few ORB descriptors of each, and a thumbnail.

Descriptors know a place from another angle; where there is nothing but plain walls they are
missing, and the thumbnails of light and depth remain (as in Klein and Murray 2008).
"""

from __future__ import annotations

from collections.abc import Collection

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.keyframe_images import KeyframeImage
from meslam_core.odometry.features import FAST_THRESHOLD

Floats = NDArray[np.float64]

# The strongest features of an image, 32 bytes each. Of simulated and recorded views 0.8 s away
# from the nearest keyframe all find a keyframe within 40 cm and 25 degrees first.
FEATURES = 100
# Columns and rows of a thumbnail.
THUMBNAIL = (20, 15)
# A cell needs so large a share of pixels with depth to have one.
LEAST_MEASURED = 0.1
# Of 256 bits; descriptors that differ in more say nothing of each other.
FARTHEST_BITS = 64
# A turn by which two views differ as much as by a metre of the way [m/rad].
LEVER_M = 0.7


class PlaceRecall:
    """Remembers what keyframes look like, at most so many of them.

    Of more than that, those are forgotten that have another one right beside them, so that
    what remains is spread over all places and directions.

    Args:
        most: keyframes that are remembered, at most 4.4 kB each.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._detector = cv2.ORB.create(FEATURES, fastThreshold=FAST_THRESHOLD)
        self._keyframes: list[int] = []
        self._descriptors: list[NDArray[np.uint8]] = []
        self._thumbnails: list[NDArray[np.float16]] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def keyframes(self) -> NDArray[np.int64]:
        """Numbers of those that are remembered."""
        return np.array(self._keyframes, np.int64)

    def add(self, keyframe: int, image: KeyframeImage, poses: Floats) -> None:
        """Remember a keyframe, and forget another one where there are too many.

        Args:
            keyframe: its number.
            image: of it.
            poses: (K, 4, 4) T_map_camera of all keyframes so far, this one's included.
        """
        self._keyframes.append(keyframe)
        self._descriptors.append(self._describe(image))
        self._thumbnails.append(_thumbnail(image))
        if len(self) > self._most:
            self._forget(_most_alike(poses[self.keyframes]))

    def forget(self, since: int) -> None:
        """Forget the keyframes from a number on."""
        for row in reversed(np.flatnonzero(self.keyframes >= since).tolist()):
            self._forget(row)

    def propose(
        self,
        image: KeyframeImage,
        count: int,
        tried: Collection[int] = (),
        before: int | None = None,
    ) -> list[int]:
        """Keyframes that look like a view, the most promising first.

        Those that most features have their best match in and those with the most similar
        thumbnails take turns.

        Args:
            image: the view.
            count: at most so many.
            tried: keyframes that were tried in vain, as often as they occur; they come later.
            before: only keyframes below this number.
        """
        if not len(self):
            return []
        discount = np.ones(len(self)) if before is None else (self.keyframes < before) * 1.0
        for keyframe in tried:
            discount[self.keyframes == keyframe] *= 0.5
        votes, likeness = discount * self._votes(image), discount * self._likeness(image)
        proposed: list[int] = []
        for pair in zip(np.argsort(-votes, kind="stable"), np.argsort(-likeness), strict=True):
            for row, score in zip(pair, (votes, likeness), strict=True):
                if score[row] > 0.0 and self._keyframes[row] not in proposed:
                    proposed.append(self._keyframes[row])
            if len(proposed) >= count:
                break
        return proposed[:count]

    def _votes(self, image: KeyframeImage) -> Floats:
        """How well the features of a view match those of each keyframe."""
        votes = np.zeros(len(self))
        wanted = self._describe(image)
        owners = np.repeat(np.arange(len(self)), [len(each) for each in self._descriptors])
        if not len(wanted) or not len(owners):
            return votes
        known = np.concatenate(self._descriptors)
        for match in cv2.BFMatcher(cv2.NORM_HAMMING).match(wanted, known):
            votes[owners[match.trainIdx]] += max(0.0, FARTHEST_BITS - match.distance)
        return votes

    def _likeness(self, image: KeyframeImage) -> Floats:
        """Correlation of a view's thumbnail with that of each keyframe."""
        return np.asarray(np.array(self._thumbnails, np.float64) @ _thumbnail(image), np.float64)

    def _describe(self, image: KeyframeImage) -> NDArray[np.uint8]:
        keypoints, descriptors = self._detector.detectAndCompute(image.gray, None)
        return np.asarray(descriptors if keypoints else np.zeros((0, 32)), np.uint8)

    def _forget(self, row: int) -> None:
        del self._keyframes[row]
        del self._descriptors[row]
        del self._thumbnails[row]


def _thumbnail(image: KeyframeImage) -> NDArray[np.float16]:
    """Light and inverse depth on a coarse grid, each of zero mean and unit length."""
    light = cv2.resize(image.gray, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float64)
    measured = cv2.resize((image.depth > 0) * 1.0, THUMBNAIL, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(image.depth.astype(np.float64), THUMBNAIL, interpolation=cv2.INTER_AREA)
    known = measured > LEAST_MEASURED
    nearness = np.where(known, measured / np.maximum(depth, 1.0), 0.0)
    nearness = np.where(known, nearness - nearness.sum() / max(known.sum(), 1), 0.0)
    parts = [
        part.ravel() / (np.linalg.norm(part) + 1e-12) for part in (light - light.mean(), nearness)
    ]
    return np.concatenate(parts).astype(np.float16)


def _most_alike(poses: Floats) -> int:
    """Row of that pose (K, 4, 4) which another one comes nearest to, the older of the two."""
    positions = (poses[:, :3, 3] - poses[-1, :3, 3]).astype(np.float32)
    rotations = poses[:, :3, :3].reshape(len(poses), 9).astype(np.float32)
    lengths = np.square(positions).sum(axis=1)
    apart = lengths[:, None] + lengths - 2.0 * (positions @ positions.T)
    # trace(A^T B) = 1 + 2 cos(angle), and the chord of the angle is sqrt(2 - 2 cos(angle)).
    chords = 3.0 - rotations @ rotations.T
    apart = np.sqrt(np.maximum(apart, 0.0)) + LEVER_M * np.sqrt(np.maximum(chords, 0.0))
    np.fill_diagonal(apart, np.inf)
    return int(np.argmin(apart)) // len(poses)
