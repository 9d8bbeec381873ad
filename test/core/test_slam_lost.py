"""A camera that is covered, or carried elsewhere: what the pipeline says, and how it goes on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.textured_room import CAMERA, frame_at, path

from meslam_core.evaluation.relocalisation import (
    COVERED,
    KIDNAPPED,
    UNSEEN,
    WRONG_M,
    Disturbed,
    Trial,
)
from meslam_core.odometry import make_odometry
from meslam_core.slam import Slam, TrackingState
from meslam_core.trajectory import Trajectory

LARGE = CAMERA.scaled(2.0)
FRAMES = 32
SEEN = 18
COVERED_S = 1.0


@pytest.fixture(scope="module")
def disturbed(quick_config) -> Iterator[Disturbed]:
    """A walk of 90 cm and 50 degrees that has been mapped; one disturbance follows the other."""
    poses = path(FRAMES, step_m=0.03, step_deg=1.6)
    frames = [frame_at(pose, number, LARGE) for number, pose in enumerate(poses)]
    slam = Slam(quick_config)
    odometry = make_odometry(quick_config.odometry, quick_config.sensor)
    for frame in frames:
        assert slam.process(frame, odometry.process(frame)).state is TrackingState.OK
    truth = Trajectory(np.array([frame.stamp_ns for frame in frames]), np.array(poses))
    yield Disturbed(slam, odometry, MemoryRecording(frames), truth)
    slam.wait()


@pytest.mark.parametrize(
    "trial", [Trial(KIDNAPPED, 2, SEEN), Trial(KIDNAPPED, 12, SEEN), Trial(COVERED, 1, SEEN)]
)
def test_a_camera_is_found_again_where_it_has_been_before(disturbed, trial):
    outcome = disturbed.run(trial, COVERED_S)
    assert TrackingState.OK not in outcome.states[:1]
    assert TrackingState.RELOCALISING in outcome.states
    assert outcome.within(2.0)
    assert outcome.worst_m < WRONG_M
    assert outcome.states[-1] is TrackingState.OK


def test_a_camera_stays_lost_where_nobody_has_been_and_trains_nothing(disturbed):
    slam = disturbed.slam
    slam.wait()
    weights, keyframes = slam.atlas.working.weights(), len(slam.keyframes)
    outcome = disturbed.run(Trial(UNSEEN, 6, 10), COVERED_S)
    assert outcome.found_s is None
    assert outcome.wrong == 0
    assert outcome.states[-1] is TrackingState.LOST
    assert "lost" in outcome.reason
    np.testing.assert_array_equal(slam.atlas.working.weights(), weights)
    assert len(slam.keyframes) == keyframes
    # And is found when it is carried back.
    assert disturbed.run(Trial(COVERED, 20, 8), COVERED_S).within(2.0)
