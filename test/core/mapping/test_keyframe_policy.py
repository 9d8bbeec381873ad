"""When a frame becomes a keyframe."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.textured_room import frame_at

from meslam_core.field.rendering import render
from meslam_core.mapping.keyframe_policy import REVISITED_AFTER_NS, KeyframePolicy
from meslam_core.mapping.keyframes import rays_at
from meslam_core.se3 import Pose, exp

REFERENCE = 2


@pytest.fixture
def is_keyframe(mapped_room):
    policy = KeyframePolicy(mapped_room.config.keyframes, mapped_room.config.field)

    def ask(T_map_camera: Pose, offset_m: float = 0.0) -> bool:
        frame = frame_at(T_map_camera, offset_m=offset_m)
        rows, columns = np.mgrid[4:120:7, 4:160:7].reshape(2, -1)
        rays = rays_at(frame, rows, columns)
        return policy.is_keyframe(
            mapped_room.region, mapped_room.keyframes, REFERENCE, frame.camera, T_map_camera, rays
        )

    return ask


@pytest.fixture
def reference(mapped_room) -> Pose:
    return mapped_room.poses[mapped_room.mapped[REFERENCE]]


def moved(pose: Pose, **twist: float) -> Pose:
    """A pose after a motion in the camera's own frame; x right, z forward."""
    names = ("x", "y", "z", "pitch", "yaw", "roll")
    return pose @ exp(np.array([twist.get(name, 0.0) for name in names]))


def test_a_view_that_the_map_explains_is_none(is_keyframe, reference):
    assert not is_keyframe(reference)
    assert not is_keyframe(moved(reference, x=0.05, yaw=0.02))


@pytest.mark.parametrize(
    "twist", [{"z": 0.25}, {"x": -0.25}, {"roll": np.deg2rad(20)}, {"yaw": np.deg2rad(17)}]
)
def test_motion_and_rotation_make_one(is_keyframe, reference, twist):
    assert is_keyframe(moved(reference, **twist))


def test_lost_overlap_makes_one_before_the_motion_is_large(is_keyframe, reference):
    # The horizontal field of view is 63 degrees: a turn of 14 leaves three quarters less.
    assert is_keyframe(moved(reference, yaw=np.deg2rad(14.5), x=0.1))


def test_a_scene_that_changed_makes_one(is_keyframe, reference):
    # Everything is half a metre farther than the map says.
    assert is_keyframe(reference, offset_m=0.5)


@pytest.mark.parametrize("number", [5, 25])
def test_distances_are_those_of_the_volume_rendering(mapped_room, number):
    frame, pose = mapped_room.frame(number), mapped_room.poses[number]
    rows, columns = np.mgrid[4:120:11, 4:160:11].reshape(2, -1)
    rays = rays_at(frame, rows, columns)
    policy = KeyframePolicy(mapped_room.config.keyframes, mapped_room.config.field)
    along = torch.linspace(0.05, 5.0, 2000).expand(len(rays), -1)
    rotation, centre = (torch.from_numpy(part).float() for part in (pose[:3, :3], pose[:3, 3]))
    points = centre + along[..., None] * (rays.directions @ rotation.T)[:, None]
    inputs = mapped_room.region.to_region(points.reshape(-1, 3)).numpy()
    values = torch.from_numpy(mapped_room.region.field.predict(inputs)).reshape(*along.shape, 4)
    dense = render(values[..., 0], values[..., 1:], along, mapped_room.config.field)
    error = policy.rendered_distances(mapped_room.region, pose, rays) - dense.distance_m.numpy()
    assert np.median(np.abs(error)) < 0.005
    assert np.mean(np.abs(error) < 0.03) > 0.95


@pytest.mark.parametrize(
    ("twist", "found"), [({}, True), ({"x": 0.1, "yaw": 0.1}, True), ({"roll": 0.5}, False)]
)
def test_a_keyframe_from_long_ago_stands_for_what_is_seen_there_again(
    mapped_room, reference, twist, found
):
    policy = KeyframePolicy(mapped_room.config.keyframes, mapped_room.config.field)
    keyframes, region = mapped_room.keyframes, mapped_room.region
    later_ns = keyframes.stamps_ns[-1] + REVISITED_AFTER_NS + 1
    pose = moved(reference, **twist)
    revisited = policy.revisited(region, keyframes, later_ns, pose)
    assert revisited == (REFERENCE if found else None)
    soon_ns = keyframes.stamps_ns[0] + REVISITED_AFTER_NS
    assert policy.revisited(region, keyframes, soon_ns, pose) is None
