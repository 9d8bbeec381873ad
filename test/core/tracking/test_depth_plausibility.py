"""What is said of depth images that cannot be used, or whose unit is doubtful."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from meslam_core.config import SensorConfig
from meslam_core.tracking.depth_plausibility import is_stuck, unusable_depth, warn_of_depth

CONFIG = SensorConfig()
ROOM_M = np.linspace(0.8, 3.5, 60 * 80, dtype=np.float32).reshape(60, 80)


def test_a_room_is_not_doubted(caplog: pytest.LogCaptureFixture) -> None:
    warn_of_depth(ROOM_M)
    assert not caplog.records
    assert not is_stuck(ROOM_M)


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000.0, ("millimetres taken as metres", "32FC1", "depth_scale_m")),
        (0.001, ("metres taken as millimetres", "16UC1", "depth_scale_m")),
        (5.0, ("is that its unit?", "10.8 m", "depth_scale_m")),
        (0.1, ("is that its unit?", "0.215 m", "depth_scale_m")),
    ],
)
def test_a_wrong_unit_is_told_with_its_remedy(
    scale: float, words: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    depth_m = ROOM_M * np.float32(scale)
    with caplog.at_level(logging.WARNING):
        warn_of_depth(depth_m)
    for word in words:
        assert word in caplog.text
    if scale != 0.1:
        assert words[0] in unusable_depth(depth_m, CONFIG)


def test_an_empty_image_has_no_unit(caplog: pytest.LogCaptureFixture) -> None:
    empty = np.zeros((60, 80), np.float32)
    empty[0, :3] = 900.0
    warn_of_depth(empty)
    assert not caplog.records
    assert "empty" in unusable_depth(empty, CONFIG)


def test_a_stuck_camera_is_noticed() -> None:
    stuck = np.full((60, 80), 1.25, np.float32)
    assert is_stuck(stuck)
    assert "1.25 m" in unusable_depth(stuck, CONFIG)
    assert "stuck" in unusable_depth(stuck, CONFIG)
    # Holes are no measurements, and a single other pixel is one.
    stuck[::2] = 0.0
    assert is_stuck(stuck)
    stuck[3, 5] = 1.26
    assert not is_stuck(stuck)
    assert not is_stuck(np.zeros((60, 80), np.float32))


def test_depth_in_range_that_is_all_edges() -> None:
    noise = np.where(np.indices((60, 80)).sum(axis=0) % 2, 1.0, 3.0).astype(np.float32)
    assert "edges" in unusable_depth(noise, CONFIG)
