"""Poses of all keyframes from the motions measured between them, by GTSAM."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from meslam_core.mapping.keyframe_links import LINK_OUTLIER, KeyframeLinks, MeasuredMotion
from meslam_core.se3 import Pose, inverse, orthonormalized

Floats = NDArray[np.float64]

ITERATIONS = 20
# Keyframes that nothing measured ties keep their motion, unless something else moves them.
KEPT_WEIGHT = 0.01
# Of the first pose, which holds the map in its frame.
FIXED_SIGMA = 1e-6


def optimised_poses(poses: Floats, links: KeyframeLinks, loops: Sequence[MeasuredMotion]) -> Floats:
    """The poses that agree best with all measured motions; the first one stays.

    Shift [m] and turn [rad] of a motion weigh alike. Links count robustly (Geman-McClure), loops
    in full.

    Args:
        poses: (K, 4, 4) T_map_camera.
        links: between keyframes.
        loops: between keyframes that were recognised; believed however little they agree with
            the poses so far.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, pose in enumerate(poses):
        start.insert(number, _pose3(pose))
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, start.atPose3(0), fixed))
    measured = links.all()
    for (i, j), rotation, translation, weight in zip(
        measured.ends.tolist(),
        measured.rotations,
        measured.translations,
        measured.weights,
        strict=True,
    ):
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation, translation
        graph.add(_between(i, j, motion, float(weight), robust=True))
    tied = {tuple(sorted(pair)) for pair in measured.ends.tolist()}
    for number in range(1, len(poses)):
        if (number - 1, number) not in tied:
            kept = inverse(poses[number - 1]) @ poses[number]
            graph.add(_between(number - 1, number, kept, KEPT_WEIGHT))
    for loop in loops:
        graph.add(_between(loop.first, loop.second, loop.T_first_second, 1.0))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(ITERATIONS)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, settings).optimize()
    return np.array([found.atPose3(number).matrix() for number in range(len(poses))])


def rigid_motion(before: Floats, after: Floats) -> Pose:
    """The motion (4, 4), map axes, that takes poses (K, 4, 4) closest to others.

    The rotation comes from the poses' own, so that poses on a line, or one alone, suffice.
    """
    turned = np.einsum("kij,klj->il", after[:, :3, :3], before[:, :3, :3])
    u, _, vt = np.linalg.svd(turned)
    motion = np.eye(4)
    motion[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    motion[:3, 3] = after[:, :3, 3].mean(axis=0) - motion[:3, :3] @ before[:, :3, 3].mean(axis=0)
    return motion


def _pose3(pose: Pose) -> gtsam.Pose3:
    return gtsam.Pose3(orthonormalized(np.asarray(pose, np.float64)))


def _between(
    first: int, second: int, motion: Pose, weight: float, robust: bool = False
) -> gtsam.BetweenFactorPose3:
    # A link of no weight would be an infinite deviation.
    precision = max(weight, 1e-9)
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Precision(6, precision)
    if robust:
        # GTSAM's threshold is for residuals divided by their deviation.
        loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(LINK_OUTLIER * precision**0.5)
        noise = gtsam.noiseModel.Robust.Create(loss, noise)
    return gtsam.BetweenFactorPose3(first, second, _pose3(motion), noise)
