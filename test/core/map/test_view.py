"""A stored map as a camera would see it."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.view import render_view


@pytest.fixture(scope="module")
def neural_map(finished_run) -> NeuralMap:
    return NeuralMap.load(finished_run.out / "map.meslam")


def test_a_view_shows_what_the_camera_saw(neural_map, room_frames, room_poses):
    frame, pose = room_frames[8], room_poses[8]
    color, depth_m = render_view(neural_map, frame.camera, pose, far_m=6.0)
    assert color.shape == frame.color.shape
    assert color.dtype == np.uint8
    seen = depth_m > 0
    assert seen.mean() > 0.95
    error_m = np.abs(depth_m - frame.depth_m)[seen]
    assert np.median(error_m) < 0.015
    assert abs(np.median((depth_m - frame.depth_m)[seen])) < 0.008
    difference = np.abs(color.astype(float) - frame.color)[seen].mean()
    assert difference < 0.5 * np.abs(frame.color - frame.color.mean(axis=(0, 1))).mean()


def test_space_that_nobody_saw_shows_nothing(neural_map, room_frames, room_poses):
    away = room_poses[8].copy()
    away[:3, 3] += (50.0, 0.0, 0.0)
    color, depth_m = render_view(neural_map, room_frames[8].camera.scaled(0.25), away, far_m=4.0)
    assert not depth_m.any()
    assert not color.any()


def test_surfaces_beyond_the_reach_are_not_looked_for(neural_map, room_frames, room_poses):
    camera = room_frames[8].camera.scaled(0.25)
    _, depth_m = render_view(neural_map, camera, room_poses[8], far_m=1.0)
    assert depth_m.max() <= 1.2
