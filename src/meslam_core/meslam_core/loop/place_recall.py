"""Which keyframes look like a view: a few ORB descriptors of each, compared with all at once."""

from __future__ import annotations

from collections.abc import Collection

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.keyframe_images import KeyframeImage
from meslam_core.odometry.features import FAST_THRESHOLD

# The strongest features of an image, 32 bytes each. Of simulated and recorded views 0.8 s away
# from the nearest keyframe all find a keyframe within 40 cm and 25 degrees first.
FEATURES = 100
# Of 256 bits; descriptors that differ in more say nothing of each other.
FARTHEST_BITS = 64
# A turn by which two views differ as much as by a metre of the way [m/rad].
LEVER_M = 0.7


class PlaceRecall:
    """Remembers what keyframes look like, at most so many of them.

    Of more than that, those are forgotten that have another one right beside them, so that
    what remains is spread over all places and directions.

    Args:
        most: keyframes that are remembered, 3.2 kB each.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._detector = cv2.ORB.create(FEATURES, fastThreshold=FAST_THRESHOLD)
        self._keyframes: list[int] = []
        self._descriptors: list[NDArray[np.uint8]] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def keyframes(self) -> NDArray[np.int64]:
        """Numbers of those that are remembered."""
        return np.array(self._keyframes, np.int64)

    def add(self, keyframe: int, image: KeyframeImage, poses: NDArray[np.float64]) -> None:
        """Remember a keyframe, and forget another one where there are too many.

        Args:
            keyframe: its number.
            image: of it.
            poses: (K, 4, 4) T_map_camera of all keyframes so far, this one's included.
        """
        self._keyframes.append(keyframe)
        self._descriptors.append(self._describe(image))
        if len(self) > self._most:
            self._forget(_most_alike(poses[self.keyframes]))

    def forget(self, keyframe: int) -> None:
        """Forget one keyframe; nothing happens where it is not known."""
        if keyframe in self._keyframes:
            self._forget(self._keyframes.index(keyframe))

    def propose(self, image: KeyframeImage, count: int, tried: Collection[int] = ()) -> list[int]:
        """The keyframes that most features of a view have their best match in, the best first.

        Args:
            image: the view.
            count: at most so many.
            tried: keyframes that were tried in vain, as often as they occur; they come later.
        """
        wanted = self._describe(image)
        if not len(wanted) or not self._descriptors:
            return []
        owners = np.repeat(np.arange(len(self)), [len(each) for each in self._descriptors])
        if not len(owners):
            return []
        known = np.concatenate(self._descriptors)
        votes = np.zeros(len(self))
        for match in cv2.BFMatcher(cv2.NORM_HAMMING).match(wanted, known):
            votes[owners[match.trainIdx]] += max(0.0, FARTHEST_BITS - match.distance)
        for keyframe in tried:
            votes[self.keyframes == keyframe] *= 0.5
        order = np.argsort(-votes, kind="stable")[:count]
        return [self._keyframes[row] for row in order if votes[row] > 0.0]

    def _describe(self, image: KeyframeImage) -> NDArray[np.uint8]:
        keypoints, descriptors = self._detector.detectAndCompute(image.gray, None)
        return np.asarray(descriptors if keypoints else np.zeros((0, 32)), np.uint8)

    def _forget(self, row: int) -> None:
        del self._keyframes[row]
        del self._descriptors[row]


def _most_alike(poses: NDArray[np.float64]) -> int:
    """Row of that pose (K, 4, 4) which another one comes nearest to, the older of the two."""
    positions = poses[:, :3, 3]
    rotations = poses[:, :3, :3].reshape(len(poses), 9)
    # trace(A^T B) = 1 + 2 cos(angle).
    cosines = np.clip(0.5 * (rotations @ rotations.T - 1.0), -1.0, 1.0)
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    apart += LEVER_M * np.arccos(cosines)
    np.fill_diagonal(apart, np.inf)
    return int(np.unravel_index(np.argmin(apart), apart.shape)[0])
