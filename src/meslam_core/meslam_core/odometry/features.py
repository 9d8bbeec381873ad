"""Sparse features of an image and the motion that their matches propose.

Dense alignment needs a guess within a few centimetres and degrees. Matched ORB features and a
robust perspective solution find motions of any size where there is texture; the dense alignment
then decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.se3 import Pose

FEATURES = 700
FAST_THRESHOLD = 10
# Lowe's ratio between the best and the second match.
RATIO = 0.8
MIN_MATCHES = 12
RANSAC_ROUNDS = 100
REPROJECTION_PX = 4.0


@dataclass(frozen=True)
class Features:
    """ORB features of one image.

    Attributes:
        pixels: (N, 2) float32, column and row.
        descriptors: (N, 32) uint8.
        points: (N, 3) float32 in the camera frame [m].
        measured: (N,) whether the pixel has depth.
        camera: intrinsics.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float32]
    measured: NDArray[np.bool_]
    camera: PinholeCamera


def find_features(
    gray: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera
) -> Features:
    """The strongest features of an image (H, W) with its depth (H, W) [m]."""
    detector = cv2.ORB.create(FEATURES, fastThreshold=FAST_THRESHOLD)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    if not keypoints:
        descriptors = np.zeros((0, 32), np.uint8)
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)
    columns, rows = np.rint(pixels).astype(int).T
    depth = depth_m[rows, columns]
    points = camera.ray_directions(pixels[:, 0], pixels[:, 1]) * depth[:, None]
    measured = np.isfinite(depth) & (depth > 0)
    return Features(pixels, np.asarray(descriptors, np.uint8), points, measured, camera)


def propose_motion(source: Features, target: Features) -> Pose | None:
    """T_target_source (4, 4) from the matches of the source's measured points; None without."""
    descriptors = source.descriptors[source.measured]
    if len(descriptors) < MIN_MATCHES or len(target.descriptors) < MIN_MATCHES:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors, target.descriptors, k=2)
    matches = [
        pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance
    ]
    if len(matches) < MIN_MATCHES:
        return None
    points = source.points[source.measured][[match.queryIdx for match in matches]]
    pixels = target.pixels[[match.trainIdx for match in matches]]
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        target.camera.matrix,
        None,
        iterationsCount=RANSAC_ROUNDS,
        reprojectionError=REPROJECTION_PX,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found or inliers is None or len(inliers) < MIN_MATCHES:
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation)[0]
    pose[:3, 3] = translation[:, 0]
    return pose if np.isfinite(pose).all() else None
