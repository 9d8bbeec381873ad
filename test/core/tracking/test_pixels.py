"""Which pixels are trusted."""

from __future__ import annotations

import numpy as np
import pytest
from data.textured_room import frame_at, path

from meslam_core.config import SensorConfig
from meslam_core.tracking.pixels import choose_pixels, trusted_pixels, usable_share

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
