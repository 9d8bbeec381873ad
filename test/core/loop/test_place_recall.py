"""Keyframes that look like a view."""

from __future__ import annotations

import numpy as np
import pytest
from data.textured_room import CAMERA, frame_at, path

from meslam_core.loop.place_recall import PlaceRecall
from meslam_core.mapping.keyframe_images import KeyframeImage
from meslam_core.se3 import Pose, exp

LARGE = CAMERA.scaled(2.0)
START = path(1)[0]
NEAR = exp(np.array([0.02, 0.01, 0.0, 0.01, 0.02, 0.0]))


def turned(degrees: float) -> Pose:
    return START @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(degrees), 0.0]))


def view(pose: Pose) -> KeyframeImage:
    return KeyframeImage.of(frame_at(pose, 0, LARGE), LARGE.width)


def dark() -> KeyframeImage:
    size = (LARGE.height, LARGE.width)
    return KeyframeImage(np.zeros(size, np.uint8), np.zeros(size, np.uint16), LARGE, 0)


@pytest.fixture(scope="module")
def around() -> tuple[PlaceRecall, list[Pose]]:
    """Textured and plain views in steps of 40 degrees; must not be changed."""
    places, poses = PlaceRecall(100), [turned(40.0 * number) for number in range(9)]
    for number, pose in enumerate(poses):
        places.add(number, view(pose), np.array(poses))
    return places, poses


def test_the_keyframe_beside_a_view_comes_first(around):
    places, poses = around
    for number, pose in enumerate(poses):
        assert places.propose(view(pose @ NEAR), 3)[0] == number


def test_what_was_tried_in_vain_comes_later(around):
    places, poses = around
    wanted = view(poses[1] @ NEAR)
    assert places.propose(wanted, 1) == [1]
    assert places.propose(wanted, 1, tried=[1] * 8) != [1]


def test_a_view_of_nothing_proposes_nothing_and_may_be_remembered(around):
    places, _ = around
    assert places.propose(dark(), 3) == []
    empty = PlaceRecall(10)
    assert empty.propose(view(START), 3) == []
    empty.add(0, dark(), np.array([START]))
    assert empty.propose(view(START), 3) == []


def test_of_too_many_keyframes_those_stay_that_are_spread_over_all_directions():
    places, most = PlaceRecall(6), 6
    directions = [0.0, 60.0, 120.0, 180.0, 240.0, 300.0]
    # Many of the first direction, then one of each other.
    degrees = [*np.linspace(-3.0, 3.0, 8), *directions[1:]]
    poses = [turned(each) for each in degrees]
    for number in range(len(poses)):
        places.add(number, dark(), np.array(poses[: number + 1]))
        assert len(places) <= most
    kept = sorted(round(degrees[number] / 60.0) * 60.0 for number in places.keyframes)
    assert kept == directions
