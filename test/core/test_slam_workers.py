"""How mapping shares time with tracking: it gives way, makes up for it, and stays repeatable."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.relocalisation import mirrored
from meslam_core.mapping.frame_training import FIRST_STEPS_SHARE, MADE_UP_A_FRAME
from meslam_core.odometry import make_odometry
from meslam_core.slam import Slam, TrackingState
from meslam_core.tracking.judge import Judge

FIRST, LEAST, STEPS = 100, 3, 8
FIRST_LEAST = math.ceil(FIRST_STEPS_SHARE * FIRST)


@dataclass
class Queue:
    """Whether frames wait."""

    waits: bool

    def __call__(self) -> bool:
        return self.waits


@pytest.fixture(scope="module")
def config() -> MeslamConfig:
    return MeslamConfig.from_overrides(
        [
            "keyframes.rays=1024",
            f"mapping.first_iterations={FIRST}",
            f"mapping.iterations={STEPS}",
            f"mapping.min_iterations={LEAST}",
            f"mapping.keyframe_iterations={STEPS}",
            "mapping.rays=100",
            "mapping.current_rays=50",
            "regions.mask_extent=2.0",
        ]
    )


@pytest.fixture(scope="module")
def offered(config, room_frames):
    """Frames with their odometry."""
    follower = make_odometry(config.odometry, config.sensor)
    return [(frame, follower.process(frame)) for frame in room_frames[:8]]


def steps_of(slam: Slam, offered) -> list[int]:
    """Steps of each frame's training."""
    taken = []
    for frame, odometry in offered:
        slam.process(frame, odometry)
        slam.wait()
        taken.append(slam._mapper.wait().losses.steps)
    return taken


def test_while_frames_wait_mapping_takes_the_fewest_steps(config, offered):
    slam = Slam(config, frames_wait=lambda: True)
    assert steps_of(slam, offered[:4]) == [FIRST_LEAST, LEAST, LEAST, LEAST]


def test_a_frame_after_skipped_ones_takes_their_fewest_steps_up_to_all_its_own(config, offered):
    slam = Slam(config, frames_wait=lambda: True)
    late = [offered[number] for number in (0, 1, 3, 7)]
    assert steps_of(slam, late) == [FIRST_LEAST, LEAST, 2 * LEAST, STEPS]


def test_the_steps_of_a_result_are_those_that_were_taken(config, offered):
    slam = Slam(config, frames_wait=lambda: True)
    results = [slam.process(*pair) for pair in offered[:4]]
    # The first frame's training is waited for; later ones end when the next frame was tracked.
    assert [result.losses.steps for result in results] == [FIRST_LEAST, FIRST_LEAST, LEAST, LEAST]


def test_when_nothing_waits_every_frame_gets_all_its_steps(config, offered):
    assert steps_of(Slam(config), offered[:4]) == [FIRST, STEPS, STEPS, STEPS]


def test_the_first_frames_steps_are_made_up_for_when_nothing_waits_any_more(config, offered):
    queue = Queue(waits=True)
    slam = Slam(config, frames_wait=queue)
    assert steps_of(slam, offered[:2]) == [FIRST_LEAST, LEAST]
    queue.waits = False
    taken = steps_of(slam, offered[2:])
    owed = FIRST - FIRST_LEAST - LEAST
    made_up = [steps - STEPS for steps in taken]
    assert made_up[0] == MADE_UP_A_FRAME
    assert max(made_up) == MADE_UP_A_FRAME
    assert min(made_up) == 0
    # A frame's own steps count as made up, too: no more are added than are missing.
    assert owed - STEPS * len(taken) <= sum(made_up) <= owed
    assert made_up[-1] == 0


def test_frames_wait_for_the_first_steps_alone_then_catch_up(config, offered):
    queue = Queue(waits=False)
    slam = Slam(config, frames_wait=queue)
    assert steps_of(slam, offered[:1]) == [FIRST]
    queue.waits = True
    assert steps_of(slam, offered[1:3]) == [LEAST, LEAST]
    queue.waits = False
    # Steps that later frames gave up are not owed.
    assert steps_of(slam, offered[3:5]) == [STEPS, STEPS]


def test_two_runs_are_the_same_to_the_last_bit(config, offered):
    def run() -> tuple[np.ndarray, np.ndarray, list]:
        slam = Slam(config, seed=5)
        results = [slam.process(*pair) for pair in offered]
        slam.wait()
        assert slam.atlas is not None
        return slam.trajectory().poses, slam.atlas.working.field.flat(), results

    first, second = run(), run()
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    for one, other in zip(first[2], second[2], strict=True):
        np.testing.assert_array_equal(one.T_map_camera, other.T_map_camera)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert (one.losses, one.is_keyframe, one.residual_m) == (
            other.losses,
            other.is_keyframe,
            other.residual_m,
        )


def test_waiting_for_training_or_not_changes_nothing(config, offered):
    def poses(wait: bool) -> np.ndarray:
        slam = Slam(config)
        for pair in offered:
            slam.track(*pair)
            if wait:
                slam._mapper.pause()
            slam.map()
        slam.wait()
        return slam.online_trajectory().poses

    np.testing.assert_array_equal(poses(True), poses(False))


def test_tracking_alone_leaves_the_map_as_it_is(config, offered):
    slam = Slam(config)
    for pair in offered[:3]:
        slam.process(*pair)
    slam.wait()
    assert slam.atlas is not None
    weights, poses = slam.atlas.working.field.flat().copy(), slam.trajectory().poses
    keyframes, version = len(slam.keyframes), slam.atlas.working.version
    result = slam.track(*offered[3])
    np.testing.assert_array_equal(slam.atlas.working.field.flat(), weights)
    np.testing.assert_array_equal(slam.trajectory().poses, poses)
    assert (len(slam.keyframes), slam.atlas.working.version) == (keyframes, version)
    assert not result.is_keyframe
    assert result.losses.steps == 0
    # The frame counts once it is mapped.
    slam.map()
    slam.wait()
    assert len(slam.trajectory().poses) == len(poses) + 1
    assert not np.array_equal(slam.atlas.working.field.flat(), weights)


def test_a_frame_is_tracked_before_it_is_mapped(config, offered):
    slam = Slam(config)
    with pytest.raises(AssertionError, match="track"):
        slam.map()
    slam.process(*offered[0])
    with pytest.raises(AssertionError, match="track"):
        slam.map()


def test_what_training_raises_reaches_the_caller(config, offered, monkeypatch):
    slam = Slam(config)
    slam.process(*offered[0])

    def fail(*arguments, **named):
        raise FloatingPointError("weights are no numbers")

    monkeypatch.setattr(slam.optimizer, "train", fail)
    slam.process(*offered[1])
    with pytest.raises(FloatingPointError, match="no numbers"):
        slam.wait()


def test_where_the_map_lags_behind_what_a_keyframe_shows_training_does_not_give_way(
    config, offered, monkeypatch
):
    often = replace(config.keyframes, translation_m=0.01)
    slam = Slam(replace(config, keyframes=often), frames_wait=lambda: True)
    assert steps_of(slam, offered[:3])[1:] == [LEAST, LEAST]
    assert len(slam.keyframes) > 1
    # Suddenly nothing fits any more, as in a region that was trained too little.
    monkeypatch.setattr(Judge, "_misfit", lambda judge, alignment: "points lie off the map")
    assert steps_of(slam, offered[3:5]) == [STEPS, STEPS]
    assert slam.state is TrackingState.DEGRADED
    # What no keyframe shows is not trained.
    keyframes = len(slam.keyframes)
    for frame, odometry in offered[5:8]:
        assert slam.process(mirrored(frame), odometry).state is TrackingState.DEGRADED
    assert slam.tracking._untrusted == 3
    assert len(slam.keyframes) == keyframes
