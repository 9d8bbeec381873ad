"""A frame's pose where the map or odometry says little."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.config import TrackingConfig
from meslam_core.frame_result import TrackingState
from meslam_core.mapping.keyframes import Rays, rays_at
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import exp
from meslam_core.tracking import frame_tracking
from meslam_core.tracking.frame_history import KeyframePoses
from meslam_core.tracking.frame_tracking import UNTRUSTED_VARIANCE, FrameTracking

PERIOD_NS = 66_666_667


def resting(room, **settings) -> FrameTracking:
    """Tracking whose camera has stood still at the room's first pose for two frames."""
    tracking = FrameTracking(TrackingConfig(**settings))
    tracking.start(room.poses[0])
    tracking.history.keyframes = KeyframePoses(room.keyframes)
    for number in range(2):
        tracking.history.add(number * PERIOD_NS, room.poses[0], 0, np.eye(4), None)
    return tracking


def bare_wall(room) -> Rays:
    """Rays of the first frame that all end on one plain wall."""
    frame, pose = room.frame(0), room.poses[0]
    rows, columns = np.mgrid[2 : frame.camera.height : 2, 2 : frame.camera.width : 2].reshape(2, -1)
    rays = rays_at(frame, rows, columns)
    ends = (rays.directions * rays.distances_m[:, None]).numpy() @ pose[:3, :3].T + pose[:3, 3]
    wall = np.abs(ends[:, 0] - 2.1) < 0.01
    assert wall.sum() > 300
    return Rays(rays.directions[wall], rays.distances_m[wall], rays.colors[wall])


def test_without_odometry_the_last_motion_keeps_the_pose_along_a_bare_wall(
    mapped_room, monkeypatch
):
    """The wall tells one distance and two angles; the rest must not drift away."""
    rays, true = bare_wall(mapped_room), mapped_room.poses[0]

    def slid() -> float:
        tracking = resting(mapped_room, color_weight=0.0)
        tracked = tracking.track(2 * PERIOD_NS, mapped_room.region, rays, None)
        assert tracked.trusted
        return float(np.linalg.norm((tracked.T_map_camera - true)[:3, 3]))

    kept = slid()
    loose = frame_tracking.MotionNoise(distance_m=10.0, angle_rad=10.0, drift=0.0)
    monkeypatch.setattr(frame_tracking, "CONTINUED_NOISE", loose)
    assert kept < 0.01
    assert kept < 0.5 * slid()


def test_uncertainty_grows_from_where_it_was_until_the_pose_is_lost(mapped_room):
    tracking = resting(mapped_room, lost_after_frames=4)
    deviations = []
    for number in range(4):
        stamp_ns = (2 + number) * PERIOD_NS
        tracked = tracking.track(stamp_ns, mapped_room.region, None, None)
        assert not tracked.trusted
        tracking.history.add(stamp_ns, tracked.T_map_camera, 0, np.eye(4), None)
        deviations.append(np.sqrt(tracked.covariance[0, 0]))
        expected = TrackingState.LOST if number == 3 else TrackingState.DEGRADED
        assert tracking.state is expected
    assert 0.01 < deviations[0] < 0.05
    assert deviations[0] < deviations[1] < deviations[2] < 0.1
    assert deviations[3] == pytest.approx(np.sqrt(UNTRUSTED_VARIANCE))


def adrift(room) -> FrameTracking:
    """Tracking that odometry has led to the room's first pose, and that it has just failed."""
    tracking = resting(room)
    rays = whole_view(room)
    led = tracking.track(2 * PERIOD_NS, room.region, rays, odometry(valid=True))
    assert tracking.state is TrackingState.OK
    tracking.history.add(2 * PERIOD_NS, led.T_map_camera, 0, np.eye(4), odometry(valid=True))
    return tracking


def whole_view(room, share: float = 1.0) -> Rays:
    """Rays of the first frame, of which a share ends where they should."""
    frame = room.frame(0)
    rows, columns = np.mgrid[2 : frame.camera.height : 4, 2 : frame.camera.width : 4].reshape(2, -1)
    rays = rays_at(frame, rows, columns)
    wrong = np.random.default_rng(0).random(len(rays)) >= share
    rays.distances_m[wrong] *= 0.7
    return rays


def odometry(valid: bool) -> OdometryEstimate:
    return OdometryEstimate(0, np.eye(4), np.eye(6), 1.0, 0.0, valid)


def test_without_odometry_a_fair_fit_is_a_guess_that_keyframes_confirm_or_refute(mapped_room):
    here = mapped_room.poses[0]
    elsewhere = here @ exp(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    expected = {
        None: (TrackingState.DEGRADED, True),
        "here": (TrackingState.OK, True),
        "elsewhere": (TrackingState.LOST, False),
    }
    known = {None: None, "here": here, "elsewhere": elsewhere}
    for case, (state, trusted) in expected.items():
        tracking, asked = adrift(mapped_room), []

        def witness(before: int | None, case=case, asked=asked):
            asked.append(before)
            return known[case]

        rays = whole_view(mapped_room, share=0.75)
        tracked = tracking.track(
            3 * PERIOD_NS, mapped_room.region, rays, odometry(valid=False), witness
        )
        assert asked == [len(mapped_room.keyframes)]
        assert (tracking.state, tracked.trusted) == (state, trusted), case
        refuted = len(mapped_room.keyframes) if case == "elsewhere" else None
        assert tracking.take_refuted() == refuted
        assert tracking.take_refuted() is None


@pytest.mark.parametrize(
    ("elsewhere_m", "state"), [(None, TrackingState.OK), (0.5, TrackingState.LOST)]
)
def test_without_odometry_a_perfect_fit_is_believed_unless_a_keyframe_knows_better(
    mapped_room, elsewhere_m, state
):
    """A desk fits itself half a metre off."""
    tracking, here = adrift(mapped_room), mapped_room.poses[0]
    known = None
    if elsewhere_m is not None:
        known = here @ exp(np.array([elsewhere_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    tracked = tracking.track(
        3 * PERIOD_NS,
        mapped_room.region,
        whole_view(mapped_room),
        odometry(valid=False),
        lambda before: known,
    )
    assert tracking.state is state
    assert tracked.trusted is (state is TrackingState.OK)


def test_without_odometry_a_poor_fit_is_not_trained(mapped_room):
    tracking = adrift(mapped_room)
    rays = whole_view(mapped_room, share=0.45)
    tracked = tracking.track(3 * PERIOD_NS, mapped_room.region, rays, odometry(valid=False))
    assert tracking.state is TrackingState.DEGRADED
    assert not tracked.trusted


@pytest.mark.parametrize("refutes", [False, True])
def test_without_odometry_a_view_off_the_map_that_keyframes_know_is_looked_for_at_once(
    mapped_room, refutes
):
    tracking, here = adrift(mapped_room), mapped_room.poses[0]
    known = here @ exp(np.array([0.5 * refutes, 0.0, 0.0, 0.0, 0.0, 0.0]))
    rays = whole_view(mapped_room, share=0.2)
    tracked = tracking.track(
        3 * PERIOD_NS, mapped_room.region, rays, odometry(valid=False), lambda before: known
    )
    assert tracking.state is TrackingState.LOST
    assert not tracked.trusted
    assert "points lie on the map" in tracked.reason
    # What was mapped since is wrong only where the camera is not where it seemed to be.
    assert tracking.take_refuted() == (len(mapped_room.keyframes) if refutes else None)


def test_odometry_that_is_only_a_guess_still_tells_where_to_look(mapped_room):
    motion = exp(np.array([0.3, 0.0, 0.1, 0.0, 0.15, 0.0]))
    start = mapped_room.poses[0] @ np.linalg.inv(motion)

    def error_m(T_odom_camera) -> float:
        tracking = adrift(mapped_room)
        tracking.history.add(3 * PERIOD_NS, start, 0, np.linalg.inv(motion), odometry(valid=True))
        guess = OdometryEstimate(0, T_odom_camera, np.eye(6), 1.0, 0.0, valid=False)
        tracked = tracking.track(25 * PERIOD_NS, mapped_room.region, whole_view(mapped_room), guess)
        return float(np.linalg.norm((tracked.T_map_camera - mapped_room.poses[0])[:3, 3]))

    assert error_m(motion) < 0.02
    assert error_m(np.eye(4)) > 0.1
