"""A pose graph of keyframes, optimised by GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np

from meslam_core.se3 import Pose
from peers.rgbd_registration import Registration

# Standard deviations (rad, m) of the first keyframe, which defines the map.
ANCHOR_SIGMA = 1e-6


class KeyframeGraph:
    """Keyframes and the links between them.

    Args:
        link_sigma_m: standard deviation of a link's translation where all pixels correspond [m].
        robust: width of the Geman-McClure loss in standard deviations for links other than those
            from each keyframe to the next; 0 for none.
    """

    def __init__(self, link_sigma_m: float, robust: float) -> None:
        self._link_sigma_m = link_sigma_m
        self._robust = robust
        self._graph = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._links: set[tuple[int, int]] = set()
        self.poses: list[Pose] = []
        """T_map_keyframe of all keyframes."""

    def add_keyframe(self, T_map_keyframe: Pose) -> int:
        """A new keyframe; its number."""
        number = len(self.poses)
        pose = gtsam.Pose3(T_map_keyframe)
        if not number:
            anchor = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
            self._graph.add(gtsam.PriorFactorPose3(0, pose, anchor))
        self._values.insert(number, pose)
        self.poses.append(T_map_keyframe)
        return number

    def is_linked(self, one: int, other: int) -> bool:
        """Whether there is a link between two keyframes."""
        return (min(one, other), max(one, other)) in self._links

    def add_link(self, target: int, source: int, registration: Registration) -> None:
        """Bind two keyframes by their registration."""
        measured = gtsam.Pose3(registration.T_target_source)
        # GTSAM perturbs on the right, in the source's frame.
        adjoint = measured.AdjointMap()
        information = adjoint.T @ registration.information @ adjoint / self._link_sigma_m**2
        information = 0.5 * (information + information.T) + 1e-6 * np.eye(6)
        noise = gtsam.noiseModel.Gaussian.Information(information)
        if self._robust and abs(source - target) > 1:
            loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(self._robust)
            noise = gtsam.noiseModel.Robust.Create(loss, noise)
        self._graph.add(gtsam.BetweenFactorPose3(target, source, measured, noise))
        self._links.add((min(target, source), max(target, source)))

    @property
    def links(self) -> int:
        """Number of links."""
        return len(self._links)

    def optimize(self) -> None:
        """Move all keyframes to where the links agree best."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(50)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, parameters)
        self._values = optimizer.optimize()
        self.poses = [self._values.atPose3(number).matrix() for number in range(len(self.poses))]
