"""Poses that fit the map and cannot be right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from meslam_core.config import TrackingConfig
from meslam_core.mapping.keyframes import Rays, rays_at
from meslam_core.odometry import MotionNoise, OdometryEstimate
from meslam_core.se3 import Pose, exp
from meslam_core.tracking.evidence import colour_likeness
from meslam_core.tracking.field_tracker import Alignment, FieldTracker, PosePrior
from meslam_core.tracking.frame_history import FrameHistory, KeyframePoses
from meslam_core.tracking.plausibility import (
    ASKED_AT_ONCE,
    FEW_KEYFRAMES,
    THEN_EVERY,
    Plausibility,
)

PERIOD_NS = 50_000_000
SURE = np.eye(6) * 1e-4


def odometry(valid: bool) -> OdometryEstimate:
    return OdometryEstimate(0, np.eye(4), np.eye(6), 1.0, 0.0, valid)


def all_rays(room, number: int = 0) -> Rays:
    frame = room.frame(number)
    rows, columns = np.mgrid[2 : frame.camera.height : 4, 2 : frame.camera.width : 4].reshape(2, -1)
    return rays_at(frame, rows, columns)


def other_colours(rays: Rays) -> Rays:
    """The same surface, painted otherwise."""
    order = torch.from_numpy(np.random.default_rng(0).permutation(len(rays)))
    return Rays(rays.directions, rays.distances_m, rays.colors[order])


class Checked:
    """A camera that the map confirmed at the room's first pose one frame ago."""

    def __init__(self, room, **limits: float) -> None:
        self.room = room
        history = FrameHistory()
        history.keyframes = KeyframePoses(room.keyframes)
        self.plausibility = Plausibility(TrackingConfig(**limits), history)
        self.plausibility.pass_by(odometry(valid=True))
        self.plausibility.confirm(0)
        history.add(0, room.poses[0], 0, np.eye(4), None)

    def alignment(self, **found: float) -> Alignment:
        pose, rays = self.room.poses[0], all_rays(self.room)
        alignment = FieldTracker(TrackingConfig()).align(self.room.region, rays, pose)
        return replace(alignment, T_map_camera=pose, **found)


def moved(room, distance_m: float, degrees: float = 0.0) -> Pose:
    return room.poses[0] @ exp(np.array([distance_m, 0.0, 0.0, 0.0, np.deg2rad(degrees), 0.0]))


def test_a_camera_that_valid_odometry_leads_is_not_doubted(mapped_room):
    plausibility = Checked(mapped_room).plausibility
    plausibility.pass_by(odometry(valid=True))
    assert plausibility.followed
    assert not plausibility.doubted


@pytest.mark.parametrize(("distance_m", "degrees"), [(0.25, 0.0), (0.0, 22.0)])
def test_motion_that_is_too_fast_is_impossible(mapped_room, distance_m, degrees):
    plausibility = Checked(mapped_room, max_speed_m_s=3.0, max_turn_deg_s=300.0).plausibility
    objection = plausibility.impossible(PERIOD_NS, moved(mapped_room, distance_m, degrees))
    assert "impossible motion" in objection
    slower = moved(mapped_room, 0.5 * distance_m, 0.5 * degrees)
    assert plausibility.impossible(PERIOD_NS, slower) == ""
    # Over a longer time it is not.
    far = moved(mapped_room, distance_m, degrees)
    assert plausibility.impossible(4 * PERIOD_NS, far) == ""


def test_the_map_must_not_contradict_odometry(mapped_room):
    plausibility = Checked(mapped_room, max_conflict_m=0.1).plausibility
    plausibility.pass_by(odometry(valid=True))
    here = mapped_room.poses[0]
    far = PosePrior(moved(mapped_room, 0.12), SURE)
    assert "odometry has it" in plausibility.conflict(far, here)
    assert plausibility.conflict(PosePrior(moved(mapped_room, 0.08), SURE), here) == ""
    plausibility.pass_by(odometry(valid=False))
    assert plausibility.conflict(far, here) == ""


def test_a_camera_is_adrift_from_the_first_failure_until_a_pose_is_confirmed(mapped_room):
    plausibility = Checked(mapped_room).plausibility
    for valid in (False, True, True):
        plausibility.pass_by(odometry(valid))
        assert not plausibility.followed
        assert plausibility.doubted
    assert plausibility.adrift_since == len(mapped_room.keyframes)
    # A guess lets odometry count again, but does not end the doubt.
    plausibility.accept(PERIOD_NS)
    plausibility.pass_by(odometry(valid=True))
    assert plausibility.followed
    assert plausibility.doubted
    plausibility.confirm(2 * PERIOD_NS)
    plausibility.pass_by(odometry(valid=True))
    assert plausibility.followed
    assert not plausibility.doubted
    assert plausibility.adrift_since is None


def test_odometry_from_elsewhere_tells_the_motion_over_any_gap(mapped_room):
    plausibility = Checked(mapped_room).plausibility
    wheels = MotionNoise(distance_m=0.01, angle_rad=0.01, drift=0.0)
    for valid in (False, False, False):
        plausibility.pass_by(replace(odometry(valid), noise=wheels))
        assert not plausibility.followed
    plausibility.pass_by(replace(odometry(valid=True), noise=wheels))
    assert plausibility.followed
    assert not plausibility.doubted


def test_where_there_never_was_odometry_its_silence_means_nothing(mapped_room):
    history = FrameHistory()
    history.keyframes = KeyframePoses(mapped_room.keyframes)
    plausibility = Plausibility(TrackingConfig(), history)
    plausibility.pass_by(odometry(valid=False))
    plausibility.pass_by(None)
    assert not plausibility.followed
    assert not plausibility.doubted


def test_the_map_alone_is_certain_only_of_what_it_knew_before(mapped_room):
    checked = Checked(mapped_room)
    plausibility, region = checked.plausibility, mapped_room.region
    rays, alignment = all_rays(mapped_room), checked.alignment()
    plausibility.pass_by(odometry(valid=False))
    assert plausibility.certain(region, rays, alignment)
    assert not plausibility.certain(region, rays, checked.alignment(inlier_ratio=0.85))
    assert not plausibility.certain(region, other_colours(rays), alignment)
    plausibility.accept(PERIOD_NS)
    assert not plausibility.certain(region, rays, alignment)


def test_a_guess_needs_points_and_colours_unless_odometry_leads_to_it(mapped_room):
    checked = Checked(mapped_room)
    plausibility, region = checked.plausibility, mapped_room.region
    rays, alignment = all_rays(mapped_room), checked.alignment()
    few = checked.alignment(inlier_ratio=0.45)
    plausibility.pass_by(odometry(valid=False))
    assert "lie on the map" in plausibility.unlikely(region, rays, few)
    assert "other colours" in plausibility.unlikely(region, other_colours(rays), alignment)
    assert plausibility.unlikely(region, rays, alignment) == ""
    plausibility.accept(PERIOD_NS)
    plausibility.pass_by(odometry(valid=True))
    assert plausibility.unlikely(region, other_colours(rays), few) == ""


def test_a_long_path_adrift_may_have_drifted_and_a_short_one_has_not(mapped_room):
    plausibility = Checked(mapped_room).plausibility
    plausibility.pass_by(odometry(valid=False))
    known = len(mapped_room.keyframes)
    assert not plausibility.drifted(0.2, 0.1)
    plausibility.adrift_since = known - FEW_KEYFRAMES - 1
    assert plausibility.drifted(0.2, 0.1)
    assert not plausibility.drifted(0.4, 0.1)
    assert not plausibility.drifted(0.2, 0.4)


def test_known_keyframes_are_asked_at_once_and_then_now_and_then(mapped_room):
    plausibility = Checked(mapped_room).plausibility
    asked = [plausibility.asks() for _ in range(ASKED_AT_ONCE + 2 * THEN_EVERY)]
    assert all(asked[:ASKED_AT_ONCE])
    assert sum(asked[ASKED_AT_ONCE:]) == 2


def test_colours_correlate_where_the_camera_is_whatever_the_exposure(mapped_room):
    rays = all_rays(mapped_room)
    here = mapped_room.poses[0]
    right = colour_likeness(mapped_room.region, rays, here)
    darker = Rays(rays.directions, rays.distances_m, 0.3 * rays.colors + 0.1)
    assert right > 0.8
    assert colour_likeness(mapped_room.region, darker, here) == pytest.approx(right, abs=1e-3)
    assert colour_likeness(mapped_room.region, other_colours(rays), here) < 0.2


def test_colours_tell_nothing_where_there_are_none_or_nothing_was_seen(mapped_room):
    rays = all_rays(mapped_room)
    white = Rays(rays.directions, rays.distances_m, torch.ones_like(rays.colors))
    assert colour_likeness(mapped_room.region, white, mapped_room.poses[0]) is None
    away = moved(mapped_room, 30.0)
    assert colour_likeness(mapped_room.region, rays, away) is None
