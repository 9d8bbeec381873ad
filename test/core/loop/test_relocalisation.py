"""A lost camera is found where keyframes and map agree, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.textured_room import CAMERA, frame_at

from meslam_core.config import RelocalisationConfig
from meslam_core.evaluation.relocalisation import mirrored
from meslam_core.frame import RgbdFrame
from meslam_core.loop.relocalisation import Relocaliser
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframes import Rays, rays_at
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, exp, inverse, log
from meslam_core.tracking.pixels import choose_pixels

LARGE = CAMERA.scaled(2.0)
BESIDE = exp(np.array([0.04, -0.02, 0.03, 0.02, -0.05, 0.01]))
AWAY = exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(170.0), 0.0]))


class Searched:
    """The mapped room, whose keyframes are remembered or not."""

    def __init__(self, room, remembered: bool, **limits: float) -> None:
        self.room = room
        linker = CovisibilityLinker(room.keyframes, room.config, ScratchFile())
        config = RelocalisationConfig(**limits)
        self.relocaliser = Relocaliser(config, room.config.tracking, room.atlas, linker)
        if remembered:
            for keyframe, number in enumerate(room.mapped):
                linker.keep(keyframe, frame_at(room.poses[number], number, LARGE))
                self.relocaliser.remember(keyframe)

    def find(self, pose: Pose, believed: Pose | None = None, frame: RgbdFrame | None = None):
        frame = frame_at(pose, 7, LARGE) if frame is None else frame
        believed = pose @ AWAY if believed is None else believed
        return self.relocaliser.find(frame, sample(frame), believed)


def sample(frame: RgbdFrame) -> Rays:
    return rays_at(frame, *choose_pixels(frame.depth_m > 0, 1500, np.random.default_rng(0)))


def distance_and_angle(first: Pose, second: Pose) -> tuple[float, float]:
    twist = log(inverse(first) @ second)
    return float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))


@pytest.mark.parametrize("number", [3, 18, 37])
def test_a_view_beside_the_keyframes_is_found_wherever_the_camera_was_before(mapped_room, number):
    true = mapped_room.poses[number] @ BESIDE
    sighting = Searched(mapped_room, remembered=True).find(true)
    distance, angle = distance_and_angle(true, sighting.alignment.T_map_camera)
    assert distance < 0.02
    assert angle < 0.01
    nearest = int(np.argmin(np.abs(np.array(mapped_room.mapped) - number)))
    assert abs(sighting.keyframe - nearest) <= 1
    assert sighting.region is mapped_room.region


def test_a_view_that_no_keyframe_has_seen_is_not_found(mapped_room):
    searched = Searched(mapped_room, remembered=True)
    assert searched.find(mapped_room.poses[0] @ AWAY, believed=mapped_room.poses[0]) is None


def test_the_mirror_image_of_a_place_is_another_place(mapped_room):
    searched = Searched(mapped_room, remembered=True)
    for number in mapped_room.mapped:
        pose = mapped_room.poses[number]
        seen = mirrored(frame_at(pose, number, LARGE))
        assert searched.find(pose, believed=pose, frame=seen) is None


def test_what_has_the_same_shape_in_other_colours_is_another_place(mapped_room):
    searched = Searched(mapped_room, remembered=True)
    pose = mapped_room.poses[0] @ BESIDE
    frame = frame_at(pose, 7, LARGE)
    repainted = replace(frame, color=np.ascontiguousarray(frame.color[::-1, ::-1]))
    assert searched.find(pose, believed=pose, frame=repainted) is None


def test_keyframes_that_are_not_asked_or_forgotten_tell_nothing(mapped_room):
    searched = Searched(mapped_room, remembered=True)
    frame = frame_at(mapped_room.poses[37], 7, LARGE)
    assert searched.relocaliser.recognise(frame, sample(frame)).keyframe >= 3
    earlier = searched.relocaliser.recognise(frame, sample(frame), before=3)
    assert earlier is None or earlier.keyframe < 3
    searched.relocaliser.forget(0)
    assert searched.relocaliser.recognise(frame, sample(frame)) is None


def test_without_keyframes_the_map_is_asked_where_the_camera_was_last(mapped_room):
    searched = Searched(mapped_room, remembered=False)
    true = mapped_room.poses[5]
    sighting = searched.find(true, believed=true @ BESIDE)
    assert sighting.keyframe is None
    assert distance_and_angle(true, sighting.alignment.T_map_camera)[0] < 0.02
    assert searched.find(true) is None


@pytest.mark.parametrize(
    "limits",
    [
        {"min_inlier_ratio": 1.0},
        {"max_residual_m": 1e-4},
        {"min_colour_likeness": 1.0},
        {"min_image_likeness": 1.0, "min_fitness": 1.0},
        {"candidates": 0},
    ],
)
def test_every_piece_of_evidence_is_asked_for(mapped_room, limits):
    true = mapped_room.poses[18] @ BESIDE
    assert Searched(mapped_room, remembered=True).find(true) is not None
    assert Searched(mapped_room, remembered=True, **limits).find(true) is None
