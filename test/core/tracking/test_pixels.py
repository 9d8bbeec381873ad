"""Which pixels are trusted."""

from __future__ import annotations

import numpy as np
import pytest
from data.textured_room import frame_at, path

from meslam_core.config import SensorConfig
from meslam_core.tracking.pixels import (
    BAND_PIXELS,
    TrustedPixels,
    choose_pixels,
    trusted_pixels,
    usable_share,
)

CONFIG = SensorConfig()


def test_depth_out_of_range_is_not_trusted():
    depth = np.full((20, 20), 2.0, np.float32)
    depth[5, 5], depth[8, 8], depth[12, 12] = 0.0, 0.1, 9.0
    trusted = trusted_pixels(depth, CONFIG)
    assert not trusted[5, 5]
    assert not trusted[8, 8]
    assert not trusted[12, 12]


def test_holes_do_not_spoil_their_neighbours():
    depth = np.full((20, 20), 2.0, np.float32)
    depth[5, 5] = 0.0
    assert np.count_nonzero(trusted_pixels(depth, CONFIG)) == 399


def test_pixels_beside_a_depth_edge_are_not_trusted():
    depth = np.full((20, 20), 2.0, np.float32)
    depth[:, 10:] = 1.5
    trusted = trusted_pixels(depth, CONFIG)
    assert not trusted[:, 9:11].any()
    assert trusted[:, :9].all()
    assert trusted[:, 11:].all()


def test_a_slanted_surface_is_no_edge():
    depth = np.tile(np.linspace(1.0, 3.0, 100, dtype=np.float32), (20, 1))
    assert trusted_pixels(depth, CONFIG).all()


def test_an_image_without_depth_has_no_trusted_pixel():
    assert not trusted_pixels(np.zeros((10, 10), np.float32), CONFIG).any()


def test_the_limits_of_the_range_belong_to_it():
    depth = np.full((20, 20), CONFIG.min_depth_m, np.float32)
    depth[10:] = CONFIG.max_depth_m
    trusted = trusted_pixels(depth, CONFIG)
    assert trusted[:9].all()
    assert trusted[11:].all()
    depth[:10] = np.nextafter(np.float32(CONFIG.min_depth_m), np.float32(0.0))
    depth[10:] = np.nextafter(np.float32(CONFIG.max_depth_m), np.float32(9.0))
    assert not trusted_pixels(depth, CONFIG).any()


@pytest.mark.parametrize("hole", [np.nan, np.inf, -np.inf, -1.0])
def test_numbers_that_are_no_depth_are_holes(hole):
    depth = np.full((20, 20), 2.0, np.float32)
    depth[4:9, 4:9] = hole
    expected = np.ones((20, 20), bool)
    expected[4:9, 4:9] = False
    np.testing.assert_array_equal(trusted_pixels(depth, CONFIG), expected)


def test_every_pixel_is_judged_by_all_its_neighbours():
    # Larger than what is gone through at once, so that neighbours lie in other parts of it.
    generator = np.random.default_rng(0)
    depth = generator.uniform(1.0, 1.06, (BAND_PIXELS // 60, 250)).astype(np.float32)
    depth[generator.uniform(size=depth.shape) < 0.3] = 0.0
    around = np.pad(depth, 1)
    stack = np.lib.stride_tricks.sliding_window_view(around, (3, 3)).reshape(*depth.shape, 9)
    span = stack.max(2) - np.where(stack > 0, stack, 9.0).min(2)
    expected = (depth > 0) & (span < CONFIG.edge_threshold * depth)
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(trusted_pixels(depth, CONFIG), expected)


def test_pixels_are_counted():
    mask = np.zeros((30, 40), bool)
    mask[3:5, 4:7] = True
    assert len(TrustedPixels(mask)) == 6


def test_one_may_choose_several_times():
    mask = np.zeros((30, 40), bool)
    mask[5:20, 7:33] = True
    pixels, generator = TrustedPixels(mask), np.random.default_rng(0)
    first, second = (np.array(pixels.choose(100, generator)) for _ in range(2))
    assert not np.array_equal(first, second)
    assert mask[tuple(first)].all()
    assert mask[tuple(second)].all()


def test_chosen_pixels_are_distinct_and_trusted():
    mask = np.zeros((30, 40), bool)
    mask[5:20, 7:33] = True
    rows, columns = choose_pixels(mask, 100, np.random.default_rng(0))
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == 100
    assert mask[rows, columns].all()


def test_all_pixels_are_chosen_when_there_are_fewer_than_wanted():
    mask = np.zeros((30, 40), bool)
    mask[3, 4] = mask[20, 30] = True
    rows, columns = choose_pixels(mask, 100, np.random.default_rng(0))
    assert list(zip(rows, columns, strict=True)) == [(3, 4), (20, 30)]


def test_usable_share_counts_pixels_in_range():
    frame = frame_at(path(1)[0])
    frame.depth_m[:60] = 0.0
    assert usable_share(frame, CONFIG) == pytest.approx(0.5)
