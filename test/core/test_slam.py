"""The pipeline on a short walk through the textured room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meslam_core.evaluation.covariance import calibration
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import make_odometry
from meslam_core.se3 import exp
from meslam_core.slam import FrameResult, Slam, TrackingState
from meslam_core.trajectory import Trajectory


def walk(slam: Slam, frames: list[RgbdFrame], odometry: bool = True) -> list[FrameResult]:
    follower = make_odometry(slam.config.odometry, slam.config.sensor)
    return [slam.process(frame, follower.process(frame) if odometry else None) for frame in frames]


def covered(frame: RgbdFrame) -> RgbdFrame:
    """The same instant without any measurement."""
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


@pytest.fixture(scope="module")
def walked(quick_config, room_frames) -> tuple[Slam, list[FrameResult]]:
    slam = Slam(quick_config)
    return slam, walk(slam, room_frames)


def test_a_known_path_is_tracked(walked, room_poses, room_frames):
    slam, results = walked
    assert all(result.state is TrackingState.OK for result in results)
    truth = Trajectory(np.array([f.stamp_ns for f in room_frames]), np.array(room_poses))
    assert absolute_error(slam.online_trajectory(), truth).rmse_m < 0.01
    # The map begins at the first camera, so that the poses agree without any alignment.
    errors = np.linalg.norm(slam.trajectory().positions - truth.positions, axis=1)
    assert errors.max() < 0.025


def test_every_frame_has_a_result_that_says_how_it_went(walked, room_frames):
    slam, results = walked
    assert [result.stamp_ns for result in results] == [f.stamp_ns for f in room_frames]
    assert results[0].is_keyframe
    assert results[0].losses.steps == slam.config.mapping.first_iterations
    assert sum(result.is_keyframe for result in results) == len(slam.keyframes)
    for result in results[1:]:
        assert result.residual_m < 0.02
        assert result.inlier_ratio > 0.8
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        assert result.losses.total > 0
        assert result.losses.steps > 0
        assert result.reason == ""


def test_the_covariance_tells_how_far_the_pose_is_off(walked, room_poses):
    _, results = walked
    shifts = np.array([result.T_map_camera[:3, 3] for result in results[1:]])
    shifts -= np.array(room_poses)[1:, :3, 3]
    found = calibration(shifts, np.array([r.covariance[:3, :3] for r in results[1:]]))
    assert found.held > 0.8
    # This camera is without any error, which nothing but a truth can tell.
    assert found.predicted < 0.04


def test_the_covariance_grows_while_the_view_is_covered(quick_config, room_frames):
    frames = list(room_frames[:10])
    frames[5:9] = [covered(frame) for frame in frames[5:9]]
    deviations = [np.sqrt(np.trace(r.covariance[:3, :3])) for r in walk(Slam(quick_config), frames)]
    assert (np.diff(deviations[4:9]) > 0).all()
    assert deviations[8] > 2 * deviations[4]
    assert deviations[9] < deviations[8]


def test_the_map_starts_about_the_first_camera(walked, room_poses):
    slam, _ = walked
    np.testing.assert_allclose(slam.atlas.grid.center((0, 0, 0)), room_poses[0][:3, 3])
    np.testing.assert_allclose(slam.trajectory().poses[0], room_poses[0], atol=1e-6)


def test_the_first_pose_can_be_given(quick_config, room_frames):
    start = exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    slam = Slam(quick_config, T_map_camera=start)
    slam.process(room_frames[0])
    np.testing.assert_allclose(slam.trajectory().poses[0], start, atol=1e-6)
    np.testing.assert_allclose(slam.atlas.grid.origin, start[:3, 3])


def test_the_seed_decides_everything(quick_config, room_frames):
    follower = make_odometry(quick_config.odometry, quick_config.sensor)
    offered = [(frame, follower.process(frame)) for frame in room_frames[:5]]

    def positions(seed: int) -> np.ndarray:
        slam = Slam(quick_config, seed)
        for frame, estimate in offered:
            slam.process(frame, estimate)
        slam.finish()
        return slam.trajectory().poses

    first = positions(3)
    np.testing.assert_array_equal(first, positions(3))
    assert not np.array_equal(first, positions(4))


def test_tracking_goes_on_without_odometry(quick_config, room_poses, room_frames):
    slam = Slam(quick_config)
    results = walk(slam, room_frames[:8], odometry=False)
    assert all(result.state is TrackingState.OK for result in results)
    assert np.linalg.norm(results[-1].T_map_camera[:3, 3] - room_poses[7][:3, 3]) < 0.03


def test_frames_without_depth_are_degraded_then_lost_and_train_nothing(quick_config, room_frames):
    limit = 3
    tracking = replace(quick_config.tracking, lost_after_frames=limit)
    slam = Slam(replace(quick_config, tracking=tracking))
    walk(slam, room_frames[:3])
    slam.wait()
    weights = slam.atlas.working.field.flat()
    later = [
        replace(covered(room_frames[3]), stamp_ns=room_frames[3].stamp_ns + n) for n in range(4)
    ]
    results = walk(slam, later, odometry=False)
    expected = [TrackingState.DEGRADED] * (limit - 1) + [TrackingState.LOST] * (5 - limit)
    assert [result.state for result in results] == expected
    assert all(result.reason for result in results)
    assert all(np.isfinite(result.T_map_camera).all() for result in results)
    np.testing.assert_array_equal(slam.atlas.working.field.flat(), weights)


def test_tracking_recovers_when_the_view_returns(quick_config, room_frames):
    slam = Slam(quick_config)
    frames = list(room_frames[:10])
    frames[5] = covered(frames[5])
    results = walk(slam, frames)
    assert results[5].state is TrackingState.DEGRADED
    assert results[-1].state is TrackingState.OK


def test_a_recording_may_begin_without_depth(quick_config, room_frames):
    slam = Slam(quick_config)
    results = walk(slam, [covered(room_frames[0]), *room_frames[1:4]])
    assert results[0].state is TrackingState.INITIALISING
    assert [result.state for result in results[1:]] == [TrackingState.OK] * 3
    assert len(slam.trajectory()) == 3


def test_nothing_processed_is_an_empty_trajectory(quick_config):
    slam = Slam(quick_config)
    slam.finish()
    assert len(slam.trajectory()) == len(slam.online_trajectory()) == 0


def test_walking_out_of_a_small_region_creates_and_enters_the_next(quick_config, room_frames):
    # Boxes of 0.5 m: the walk of 30 cm leaves the first one's part at 20 cm.
    regions = replace(quick_config.regions, volume_m3=0.125, mask_extent=6.0, hysteresis_m=0.01)
    slam = Slam(replace(quick_config, regions=regions))
    results = walk(slam, room_frames)
    assert len(slam.atlas.regions) > 1
    assert slam.atlas.working.index != (0, 0, 0)
    assert all(result.state is TrackingState.OK for result in results)


def test_who_comes_back_after_a_minute_makes_no_new_keyframes(
    quick_config, room_frames, room_poses
):
    there = list(range(0, 16, 2))
    slam, period_ns = Slam(quick_config), 66_000_000
    numbers = [*there, *reversed(there), *there]
    stamps = [n * period_ns + (0 if n < len(there) else 100 * 10**9) for n in range(len(numbers))]
    frames = [replace(room_frames[k], stamp_ns=t) for k, t in zip(numbers, stamps, strict=True)]
    results = walk(slam, frames)
    assert [result.is_keyframe for result in results[: len(there)]].count(True) > 2
    assert not any(result.is_keyframe for result in results[len(there) :])
    assert all(result.state is TrackingState.OK for result in results)
    truth = np.array([room_poses[k][:3, 3] for k in numbers])
    assert np.linalg.norm(slam.trajectory().positions - truth, axis=1).max() < 0.03
    # Frames are tied to the keyframes that they come back to, and so is how certain they are.
    first, last = results[len(there)].covariance, results[2 * len(there)].covariance
    assert np.trace(last[:3, :3]) < np.trace(first[:3, :3])
