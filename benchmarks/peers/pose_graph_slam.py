"""RGB-D odometry against keyframes, with a pose graph of the keyframes.

Every frame is registered with the last keyframe; every keyframe also with those near it, and the
graph of all these links is optimised by GTSAM. The configuration is the best of `TRIED`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, inverse, orthonormalized
from peers.keyframe_graph import KeyframeGraph
from peers.rgbd_registration import PreparedFrame, Registration, RgbdRegistration


@dataclass(frozen=True)
class PoseGraphSlamConfig:
    """Settings of the peer.

    Attributes:
        width: images wider than this are halved [px].
        depth_max_m: larger depths are not used [m].
        outlier_m: larger differences of depth are outliers of registration [m].
        iterations: of registration, coarse to fine.
        wide_iterations: that come before, from a doubtful guess.
        keyframe_m, keyframe_deg: a new keyframe after this motion.
        good_fitness: share of pixels that match below which registration tries harder and a new
            keyframe is made.
        min_fitness: the same below which a frame is lost.
        link_m, link_deg: keyframes nearer than this are linked.
        link_fitness: if at least this share of pixels matches.
        link_agreement_m, link_agreement_deg: and the graph had expected the result to this.
        online_links: most links of a new keyframe besides that to the last.
        final_links: most links a keyframe has at the end, searched anew with the final poses.
        final_rounds: of searching and optimising at the end.
        wide_links: search links from the deeper pyramid, too.
        link_sigma_m: standard deviation of a perfect link's translation [m].
        robust: width of the Geman-McClure loss of links in standard deviations; 0 for none.
    """

    width: int = 320
    depth_max_m: float = 5.0
    outlier_m: float = 0.07
    iterations: tuple[int, ...] = (20, 15, 10)
    wide_iterations: tuple[int, ...] = (20, 20, 10, 1, 0)
    keyframe_m: float = 0.15
    keyframe_deg: float = 12.0
    good_fitness: float = 0.65
    min_fitness: float = 0.3
    link_m: float = 0.5
    link_deg: float = 35.0
    link_fitness: float = 0.5
    link_agreement_m: float = 0.15
    link_agreement_deg: float = 8.0
    online_links: int = 6
    final_links: int = 12
    final_rounds: int = 2
    wide_links: bool = False
    link_sigma_m: float = 0.005
    robust: float = 3.0


@dataclass(frozen=True)
class _Tracked:
    """A frame's place relative to its keyframe."""

    keyframe: int
    T_keyframe_camera: Pose


class PoseGraphSlam:
    """Odometry, keyframes, links and graph; a lost frame starts a new keyframe at the last pose.

    Args:
        config: settings.
    """

    def __init__(self, config: PoseGraphSlamConfig) -> None:
        self._config = config
        self._registration = RgbdRegistration(
            config.width, config.depth_max_m, config.outlier_m, config.iterations
        )
        self._graph = KeyframeGraph(config.link_sigma_m, config.robust)
        self._keyframes: list[PreparedFrame] = []
        self._frames: list[_Tracked] = []
        self._previous: PreparedFrame | None = None
        self._T_map_last: Pose = np.eye(4)
        self._motion: Pose = np.eye(4)

    def process(self, frame: RgbdFrame) -> Pose | None:
        """Register a frame with the last keyframe; None when it is lost."""
        prepared = self._registration.prepare(frame)
        if self._previous is None:
            self._add_keyframe(prepared, np.eye(4))
            self._frames.append(_Tracked(0, np.eye(4)))
            self._previous = prepared
            return np.eye(4)
        T_map_keyframe = self._graph.poses[-1]
        registration = self._register(prepared, self._previous)
        self._previous = prepared
        if registration.fitness < self._config.min_fitness:
            self._motion = np.eye(4)
            return None
        pose = orthonormalized(T_map_keyframe @ registration.T_target_source)
        self._motion = orthonormalized(inverse(self._T_map_last) @ pose)
        if self._is_new_keyframe(registration):
            number = self._add_keyframe(prepared, pose)
            self._graph.add_link(number - 1, number, registration)
            self._link(number, self._config.online_links)
            self._graph.optimize()
            self._frames.append(_Tracked(number, np.eye(4)))
            pose = self._graph.poses[number]
        else:
            keyframe = len(self._keyframes) - 1
            self._frames.append(_Tracked(keyframe, registration.T_target_source))
        self._T_map_last = pose
        return pose

    def finish(self) -> list[Pose]:
        """Link and optimise once more; every frame follows its keyframe."""
        for _ in range(self._config.final_rounds):
            for number in range(len(self._keyframes)):
                self._link(number, self._config.final_links)
            self._graph.optimize()
        return [
            self._graph.poses[tracked.keyframe] @ tracked.T_keyframe_camera
            for tracked in self._frames
        ]

    def _register(self, frame: PreparedFrame, previous: PreparedFrame) -> Registration:
        """T_keyframe_frame: from the expected motion, and harder where that fits badly."""
        config = self._config
        to_keyframe = inverse(self._graph.poses[-1])
        expected = to_keyframe @ self._T_map_last @ self._motion
        last = to_keyframe @ self._T_map_last
        keyframe = self._keyframes[-1]
        best = self._registration.register(frame, keyframe, expected)
        for guess in (expected, last):
            if best.fitness >= config.good_fitness:
                return best
            wide = self._registration.register(frame, keyframe, guess, wide=config.wide_iterations)
            best = max(best, wide, key=lambda result: result.fitness)
        if best.fitness < config.good_fitness:
            step = self._registration.register(
                frame, previous, self._motion, wide=config.wide_iterations
            )
            around = last @ step.T_target_source
            again = self._registration.register(frame, keyframe, around)
            best = max(best, again, key=lambda result: result.fitness)
        return best

    def _is_new_keyframe(self, registration: Registration) -> bool:
        moved, turned = _size(registration.T_target_source)
        return (
            moved > self._config.keyframe_m
            or turned > self._config.keyframe_deg
            or registration.fitness < self._config.good_fitness
        )

    def _add_keyframe(self, frame: PreparedFrame, T_map_keyframe: Pose) -> int:
        self._keyframes.append(frame)
        return self._graph.add_keyframe(T_map_keyframe)

    def _link(self, number: int, most: int) -> None:
        """Link a keyframe with up to `most` of the nearest others, where they really match."""
        config = self._config
        near = []
        for other in range(len(self._keyframes)):
            offset = inverse(self._graph.poses[other]) @ self._graph.poses[number]
            moved, turned = _size(offset)
            if other != number and moved < config.link_m and turned < config.link_deg:
                near.append((moved / config.link_m + turned / config.link_deg, other, offset))
        for _, other, expected in sorted(near, key=lambda item: item[:2])[:most]:
            if self._graph.is_linked(number, other):
                continue
            registration = self._registration.register(
                self._keyframes[number],
                self._keyframes[other],
                expected,
                wide=config.wide_iterations if config.wide_links else None,
            )
            moved, turned = _size(inverse(expected) @ registration.T_target_source)
            agrees = moved < config.link_agreement_m and turned < config.link_agreement_deg
            if agrees and registration.fitness >= config.link_fitness:
                self._graph.add_link(other, number, registration)


def _size(motion: Pose) -> tuple[float, float]:
    """Translation [m] and rotation [deg]."""
    angle = Rotation.from_matrix(motion[:3, :3]).magnitude()
    return float(np.linalg.norm(motion[:3, 3])), float(np.rad2deg(angle))

TRIED: dict = {}
