"""Pairing of colour and depth images by stamp."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from meslam_core.errors import RecordingError
from meslam_core.recordings.pairing import ordered_pairs, pair_stamps

MS = 1_000_000


def stamps(*milliseconds: float) -> np.ndarray:
    return np.array([round(value * MS) for value in milliseconds], np.int64)


def test_each_image_is_used_once_and_the_closest_pair_wins() -> None:
    pairs = pair_stamps(stamps(0, 10, 100), stamps(9, 101, 300))
    assert pairs == [(1, 0), (2, 1)]


def test_tolerance_is_exclusive_as_in_the_benchmark() -> None:
    assert pair_stamps(stamps(0), stamps(20)) == []
    assert pair_stamps(stamps(20), stamps(0)) == []
    assert pair_stamps(stamps(0), stamps(19.999)) == [(0, 0)]


def test_a_loser_takes_its_second_choice() -> None:
    assert pair_stamps(stamps(0, 8), stamps(7, 16)) == [(0, 1), (1, 0)]


def test_agrees_with_associate_py() -> None:
    generator = np.random.default_rng(0)
    color = np.sort(generator.integers(0, 10**10, 300))
    depth = np.sort(generator.integers(0, 10**10, 280))
    # The core of the benchmark's associate.py, word for word but for names.
    candidates = [
        (abs(a - b), a, b) for a in color.tolist() for b in depth.tolist() if abs(a - b) < 20 * MS
    ]
    candidates.sort()
    first, second, matches = set(color.tolist()), set(depth.tolist()), []
    for _, a, b in candidates:
        if a in first and b in second:
            first.remove(a)
            second.remove(b)
            matches.append((a, b))
    matches.sort()
    found = [(int(color[i]), int(depth[j])) for i, j in pair_stamps(color, depth)]
    assert found == matches


def test_disorder_is_sorted_and_repeats_are_skipped(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        pairs = ordered_pairs("x", stamps(100, 50, 50, 200), stamps(50, 100, 200))
    assert pairs == [(1, 0), (0, 1), (3, 2)]
    assert "skipped 1 colour images with a repeated stamp" in caplog.text
    assert "sorted 1 colour images" in caplog.text


def test_images_without_a_partner_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert ordered_pairs("x", stamps(0, 100, 200), stamps(100)) == [(1, 0)]
    assert "skipped 2 colour images without a depth image" in caplog.text


def test_no_images_and_no_pairs_are_errors() -> None:
    with pytest.raises(RecordingError, match="x has no depth images"):
        ordered_pairs("x", stamps(0), stamps())
    with pytest.raises(RecordingError, match="1 colour and 1 depth images, but none"):
        ordered_pairs("x", stamps(0), stamps(500))
