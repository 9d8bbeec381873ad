"""Lens distortion out of messages that may say anything."""

from __future__ import annotations

from resource import RUSAGE_SELF, getrusage

import numpy as np
import pytest

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError
from meslam_core.recordings.lens import Lens

CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
BENT = [0.1, -0.05, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("model", "coefficients", "words"),
    [
        ("plumb_bob", [np.nan] * 5, "not finite"),
        ("rational_polynomial", [np.inf] + [0.0] * 7, "not finite"),
        ("plumb_bob", [0.1, 0.2, 0.3], "3 coefficients, expected 4, 5"),
        ("equidistant", [0.1], "1 coefficients, expected 4"),
    ],
)
def test_unusable_coefficients_are_errors(model: str, coefficients: list, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        Lens(CAMERA, model, coefficients)


def test_no_memory_is_taken_before_the_first_image() -> None:
    """A camera_info may say any size; whoever has no image of that size pays nothing."""
    before_kb = getrusage(RUSAGE_SELF).ru_maxrss
    Lens(PinholeCamera(8192, 8192, 50.0, 50.0, 31.5, 23.5), "plumb_bob", BENT)
    assert getrusage(RUSAGE_SELF).ru_maxrss - before_kb < 100_000


def test_a_bent_image_is_straightened_and_a_straight_one_left_alone() -> None:
    depth_m = np.random.default_rng(1).random((48, 64)).astype(np.float32)
    assert not np.array_equal(Lens(CAMERA, "plumb_bob", BENT).undistort_depth(depth_m), depth_m)
    straight = Lens(CAMERA, "plumb_bob", [0.0] * 5)
    assert straight.undistort_depth(depth_m) is depth_m
