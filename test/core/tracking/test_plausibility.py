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
from meslam_core.tracking.field_tracker import FieldTracker, PosePrior
from meslam_core.tracking.frame_history import FrameHistory, KeyframePoses
from meslam_core.tracking.plausibility import Plausibility

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

    def objection(
        self,
        pose: Pose,
        prior: Pose | None = None,
        rays: Rays | None = None,
        witness: bool | None = None,
        **found: float,
    ) -> str:
        rays = all_rays(self.room) if rays is None else rays
        alignment = FieldTracker(TrackingConfig()).align(self.room.region, rays, pose)
        alignment = replace(alignment, T_map_camera=pose, **found)
        believed = PosePrior(pose if prior is None else prior, SURE)
        return self.plausibility.objection(
            PERIOD_NS, self.room.region, rays, alignment, believed, lambda pose: witness
        )


def moved(room, distance_m: float, degrees: float = 0.0) -> Pose:
    return room.poses[0] @ exp(np.array([distance_m, 0.0, 0.0, 0.0, np.deg2rad(degrees), 0.0]))


def test_a_pose_that_odometry_leads_to_is_not_objected_to(mapped_room):
    checked = Checked(mapped_room)
    checked.plausibility.pass_by(odometry(valid=True))
    assert checked.plausibility.supported
    assert checked.objection(mapped_room.poses[0]) == ""


@pytest.mark.parametrize(("distance_m", "degrees"), [(0.25, 0.0), (0.0, 22.0)])
def test_motion_that_is_too_fast_is_impossible(mapped_room, distance_m, degrees):
    checked = Checked(mapped_room, max_speed_m_s=3.0, max_turn_deg_s=300.0)
    checked.plausibility.pass_by(odometry(valid=True))
    assert "impossible motion" in checked.objection(moved(mapped_room, distance_m, degrees))
    assert checked.objection(moved(mapped_room, 0.5 * distance_m, 0.5 * degrees)) == ""


def test_the_map_must_not_contradict_odometry(mapped_room):
    checked = Checked(mapped_room, max_conflict_m=0.1)
    checked.plausibility.pass_by(odometry(valid=True))
    here = mapped_room.poses[0]
    assert "odometry has it" in checked.objection(here, prior=moved(mapped_room, 0.12))
    assert checked.objection(here, prior=moved(mapped_room, 0.08)) == ""


def test_where_odometry_failed_the_map_must_show_the_colours(mapped_room):
    checked = Checked(mapped_room)
    rays = all_rays(mapped_room)
    here = mapped_room.poses[0]
    checked.plausibility.pass_by(odometry(valid=True))
    assert checked.objection(here, rays=other_colours(rays), witness=False) == ""
    checked.plausibility.pass_by(odometry(valid=False))
    assert not checked.plausibility.supported
    assert "other colours" in checked.objection(here, rays=other_colours(rays))
    assert "lie on the map" in checked.objection(here, inlier_ratio=0.45)
    assert "no keyframe nearby" in checked.objection(here, witness=False)
    assert checked.objection(here) == checked.objection(here, witness=True) == ""


def test_odometry_that_failed_supports_nothing_until_the_map_confirms_a_pose(mapped_room):
    checked = Checked(mapped_room)
    plausibility = checked.plausibility
    for valid in (False, True, True):
        plausibility.pass_by(odometry(valid))
        assert not plausibility.supported
    plausibility.confirm(PERIOD_NS)
    plausibility.pass_by(odometry(valid=True))
    assert plausibility.supported


def test_odometry_from_elsewhere_tells_the_motion_over_any_gap(mapped_room):
    checked = Checked(mapped_room)
    wheels = MotionNoise(distance_m=0.01, angle_rad=0.01, drift=0.0)
    for valid in (False, False, False):
        checked.plausibility.pass_by(replace(odometry(valid), noise=wheels))
        assert not checked.plausibility.supported
    checked.plausibility.pass_by(replace(odometry(valid=True), noise=wheels))
    assert checked.plausibility.supported


def test_where_there_never_was_odometry_its_silence_means_nothing(mapped_room):
    checked = Checked(mapped_room)
    history = FrameHistory()
    history.keyframes = KeyframePoses(mapped_room.keyframes)
    checked.plausibility = Plausibility(TrackingConfig(), history)
    checked.plausibility.pass_by(odometry(valid=False))
    assert not checked.plausibility.supported
    rays = other_colours(all_rays(mapped_room))
    assert checked.objection(mapped_room.poses[0], rays=rays) == ""


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
