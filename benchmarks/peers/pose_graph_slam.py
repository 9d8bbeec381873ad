"""RGB-D odometry against keyframes, with a pose graph of the keyframes.

Every frame is registered with the one before and, from there, with the last keyframe; every
keyframe also with those near it, and the graph of all these links is optimised by GTSAM. The
configuration is the best of `TRIED`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, inverse, orthonormalized
from peers.keyframe_graph import KeyframeGraph
from peers.rgbd_registration import PreparedFrame, Registration, RgbdRegistration

# ATE RMSE [cm] of the refined trajectory, for settings that differ from the defaults below.
TRIED = {
    "tum_fr1_xyz": {
        "link_m=0.5 link_deg=35 link_agreement_m=0.15 link_agreement_deg=8": 1.33,
        "defaults": 1.32,
        "width=640 iterations=(20, 20, 15, 10) (a fifth of the speed), links as above": 1.27,
        "every frame against the keyframe only, wide pyramid below fitness 0.65": 1.42,
    },
    "d435_desk": {
        "defaults": 7.18,
        "no links but those from keyframe to keyframe": 7.34,
        "outlier_m=0.2": 9.88,
        "outlier_m=0.2 depth_max_m=8": 9.62,
        "link_deg=20 link_sigma_m=0.02 link_agreement_m=0.2 link_agreement_deg=6": 10.7,
        "every frame against the keyframe only, wide pyramid below fitness 0.65": 10.3,
        "the same with a depth_max_m of 3": 11.3,
        "the same without links but those from keyframe to keyframe": 9.6,
        "the same with the wide pyramid below fitness 0.5": 16.4,
        "the same at 640x480": 14.6,
        "the same with keyframe_m=0.06 keyframe_deg=5": 10.4,
        "the same with wide links up to 0.7 m, link_fitness=0.4, link_sigma_m=0.03": 15.6,
    },
    "livingroom": {
        "link_m=0.5 link_deg=35 link_agreement_m=0.15 link_agreement_deg=8": 0.99,
        "width=640 iterations=(20, 20, 15, 10) (a third of the speed)": 1.01,
        "every frame against the keyframe only, wide pyramid below fitness 0.65": 1.01,
    },
}
# Settings that differ from the defaults by recording: none, these are the best for all.
SETTINGS: dict[str, tuple[str, ...]] = {}


@dataclass(frozen=True)
class PoseGraphSlamConfig:
    """Settings of the peer.

    Attributes:
        width: images wider than this are halved [px].
        depth_max_m: larger depths are not used [m].
        outlier_m: larger differences of depth are outliers of registration [m].
        iterations: of registration, coarse to fine.
        wide_iterations: that come before, where the expected motion fits badly.
        keyframe_m, keyframe_deg: a new keyframe after this motion.
        good_fitness: share of pixels that match below which registration tries harder.
        keyframe_fitness: the same against the keyframe, below which a new one is made.
        keyframe_agreement_m, keyframe_agreement_deg: most that the way over the frame before and
            that over the keyframe may differ; else a new keyframe is made.
        min_fitness: share of pixels that match below which a frame is lost.
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
    good_fitness: float = 0.5
    keyframe_fitness: float = 0.5
    keyframe_agreement_m: float = 0.03
    keyframe_agreement_deg: float = 2.0
    min_fitness: float = 0.3
    link_m: float = 0.4
    link_deg: float = 15.0
    link_fitness: float = 0.5
    link_agreement_m: float = 0.1
    link_agreement_deg: float = 5.0
    online_links: int = 6
    final_links: int = 12
    final_rounds: int = 2
    wide_links: bool = False
    link_sigma_m: float = 0.005
    robust: float = 3.0


ITSELF = Registration(np.eye(4), np.eye(6), 1.0)


@dataclass(frozen=True)
class _Tracked:
    """A frame's place relative to its keyframe."""

    frame: PreparedFrame
    keyframe: int
    registration: Registration


class PoseGraphSlam:
    """Odometry, keyframes, links and graph.

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
        self._places: list[tuple[int, Pose]] = []
        self._previous: _Tracked | None = None
        self._motion: Pose = np.eye(4)

    def process(self, frame: RgbdFrame) -> Pose | None:
        """Register a frame with the last tracked one and the keyframe; None when it is lost."""
        prepared = self._registration.prepare(frame)
        previous = self._previous
        if previous is None:
            self._previous = self._insert_keyframe(_Tracked(prepared, 0, ITSELF))
            self._places.append((0, np.eye(4)))
            return np.eye(4)
        step = self._step(prepared, previous.frame)
        if step.fitness < self._config.min_fitness:
            self._motion = np.eye(4)
            return None
        registration = self._against_keyframe(prepared, previous, step)
        if registration is None:
            # The keyframe shows too little of the scene; the frame before takes its place.
            previous = self._insert_keyframe(previous)
            self._places[-1] = (previous.keyframe, np.eye(4))
            registration = step
        tracked = _Tracked(prepared, previous.keyframe, registration)
        self._motion = orthonormalized(inverse(self._pose(previous)) @ self._pose(tracked))
        moved, turned = _size(registration.T_target_source)
        if moved > self._config.keyframe_m or turned > self._config.keyframe_deg:
            tracked = self._insert_keyframe(tracked)
        self._places.append((tracked.keyframe, tracked.registration.T_target_source))
        self._previous = tracked
        return self._pose(tracked)

    def finish(self) -> list[Pose]:
        """Link and optimise once more; every frame follows its keyframe."""
        for _ in range(self._config.final_rounds):
            for number in range(len(self._keyframes)):
                self._link(number, self._config.final_links)
            self._graph.optimize()
        return [
            self._graph.poses[keyframe] @ T_keyframe_camera
            for keyframe, T_keyframe_camera in self._places
        ]

    def _pose(self, tracked: _Tracked) -> Pose:
        """T_map_camera."""
        return self._graph.poses[tracked.keyframe] @ tracked.registration.T_target_source

    def _step(self, frame: PreparedFrame, previous: PreparedFrame) -> Registration:
        """T_previous_frame: from the last motion, and harder where that fits badly."""
        best = self._registration.register(frame, previous, self._motion)
        for guess, wide in (
            (np.eye(4), None),
            (self._motion, self._config.wide_iterations),
            (np.eye(4), self._config.wide_iterations),
        ):
            if best.fitness >= self._config.good_fitness:
                break
            other = self._registration.register(frame, previous, guess, wide=wide)
            best = max(best, other, key=lambda result: result.fitness)
        return best

    def _against_keyframe(
        self, frame: PreparedFrame, previous: _Tracked, step: Registration
    ) -> Registration | None:
        """T_keyframe_frame; None where it is not confirmed by the way over the frame before."""
        if previous.frame is self._keyframes[-1]:
            return step
        expected = previous.registration.T_target_source @ step.T_target_source
        result = self._registration.register(frame, self._keyframes[-1], expected)
        moved, turned = _size(inverse(expected) @ result.T_target_source)
        config = self._config
        agrees = moved < config.keyframe_agreement_m and turned < config.keyframe_agreement_deg
        return result if agrees and result.fitness >= config.keyframe_fitness else None

    def _insert_keyframe(self, tracked: _Tracked) -> _Tracked:
        """Make a tracked frame the newest keyframe, link it and optimise the graph."""
        pose = self._pose(tracked) if self._keyframes else np.eye(4)
        self._keyframes.append(tracked.frame)
        number = self._graph.add_keyframe(orthonormalized(pose))
        if number:
            self._graph.add_link(tracked.keyframe, number, tracked.registration)
            self._link(number, self._config.online_links)
            self._graph.optimize()
        return _Tracked(tracked.frame, number, ITSELF)

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
