"""Trials of cameras that are covered or carried elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from data.textured_room import CAMERA, frame_at, path

from meslam_core.camera import PinholeCamera
from meslam_core.evaluation.relocalisation import (
    COVERED,
    KIDNAPPED,
    Outcome,
    Trial,
    carried,
    dark,
    mirrored,
)
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import inverse, rotation_angle

POSES = np.array(path(100, step_m=0.02, step_deg=0.5))


def outcome(found_s: float | None, error_m: float = 0.01, error_deg: float = 0.5) -> Outcome:
    trial = Trial(COVERED, 0, 3)
    angle = float(np.deg2rad(error_deg))
    return Outcome(trial, 1.0, 0.1, found_s, error_m, angle, error_m, 0, (), "")


def test_every_trial_begins_far_from_where_the_last_one_ended():
    trials = list(carried(KIDNAPPED, 30, POSES, frames=10, least=20, seed=0, least_m=0.5))
    assert len(trials) == 30
    at = len(POSES) - 1
    for trial in trials:
        assert 0 <= trial.back <= len(POSES) - trial.frames
        assert abs(trial.back - at) >= 20
        jump = inverse(POSES[at]) @ POSES[trial.back]
        assert np.linalg.norm(jump[:3, 3]) + rotation_angle(jump) >= 0.5
        at = trial.back + trial.frames - 1
    assert trials == list(carried(KIDNAPPED, 30, POSES, 10, 20, 0, least_m=0.5))
    assert trials != list(carried(KIDNAPPED, 30, POSES, 10, 20, 1, least_m=0.5))


def test_a_path_too_short_to_be_carried_along_is_refused():
    with pytest.raises(ValueError, match="nothing in 100 frames"):
        list(carried(KIDNAPPED, 1, POSES, 10, 20, 0, least_m=50.0))


def test_the_mirrored_world_is_seen_by_a_mirrored_camera():
    # Off its centre, so that a mirrored image alone would not do.
    camera = PinholeCamera(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, 70.0, 50.0)
    frame = frame_at(POSES[0], 0, camera)
    seen = mirrored(frame)

    def points(of: RgbdFrame) -> np.ndarray:
        return of.camera.pixel_directions().reshape(-1, 3) * of.depth_m.reshape(-1, 1)

    expected = points(frame).reshape(*frame.depth_m.shape, 3)[:, ::-1] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(points(seen).reshape(expected.shape), expected, atol=1e-5)
    np.testing.assert_array_equal(mirrored(seen).color, frame.color)


def test_a_covered_camera_measures_nothing():
    frame = dark(frame_at(POSES[0], 3))
    assert not frame.depth_m.any()
    assert not frame.color.any()
    assert frame.stamp_ns == frame_at(POSES[0], 3).stamp_ns


@pytest.mark.parametrize(
    ("result", "good"),
    [
        (outcome(1.9), True),
        (outcome(2.1), False),
        (outcome(None), False),
        (outcome(0.1, error_m=0.06), False),
        (outcome(0.1, error_deg=3.1), False),
    ],
)
def test_found_means_soon_and_in_the_right_place(result, good):
    assert result.within(2.0) is good
