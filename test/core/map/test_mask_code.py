from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meslam_core.errors import MapError
from meslam_core.map.mask_code import CodedBits, decode_mask, encode_mask


def room_flags(seed: int = 0) -> np.ndarray:
    """What is seen of a box with a rough wall: 0, 1 or 3."""
    generator = np.random.default_rng(seed)
    x, y, z = np.indices((30, 34, 26))
    depth = np.minimum(np.minimum(x, y) - 3, 30 - np.maximum(x, z))
    depth = depth + (generator.random(depth.shape) < 0.05)
    seen = (depth > 0).astype(np.uint8)
    return seen | ((seen > 0) & (depth < 3)) * np.uint8(2)


def size(coded: tuple[CodedBits, CodedBits]) -> int:
    return sum(len(each.packed) for each in coded)


def test_flags_come_back() -> None:
    flags = room_flags()
    assert np.array_equal(decode_mask(*encode_mask(flags), flags.shape), flags)


@given(
    shape=st.tuples(*[st.integers(0, 7)] * 3),
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0.0, 1.0),
)
@settings(max_examples=200, deadline=None)
def test_any_flags_come_back(shape: tuple[int, int, int], seed: int, share: float) -> None:
    generator = np.random.default_rng(seed)
    seen = (generator.random(shape) < share).astype(np.uint8)
    flags = seen | (seen * (generator.random(shape) < share) * 2).astype(np.uint8)
    assert np.array_equal(decode_mask(*encode_mask(flags), shape), flags)


def test_guesses_are_mostly_right_and_the_sure_ones_more_so() -> None:
    observed, near = encode_mask(room_flags())
    assert observed.counts.sum() == room_flags().size
    assert near.counts.sum() == np.count_nonzero(room_flags())
    wrong = np.unpackbits(observed.packed, count=int(observed.counts.sum()))
    classes = np.split(wrong, np.cumsum(observed.counts)[:-1])
    assert wrong.mean() < 0.05
    sure, unsure = np.concatenate(classes[6:]), np.concatenate(classes[:6])
    assert sure.mean() < 0.1 * unsure.mean()
    assert len(sure) > len(unsure)


def test_a_surface_where_nobody_looked_is_refused() -> None:
    with pytest.raises(MapError, match="not observed"):
        encode_mask(np.full((2, 2, 2), 2, np.uint8))


@given(moved=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=20))
@settings(max_examples=100, deadline=None)
def test_wrong_counts_are_noticed_or_harmless(moved: list[tuple[int, int]]) -> None:
    flags = room_flags()[:9, :8, :7]
    observed, near = encode_mask(flags)
    counts = observed.counts.astype(np.int64)
    for source, target in moved:
        amount = min(5, int(counts[source]))
        counts[source] -= amount
        counts[target] += amount
    changed = CodedBits(counts.astype(np.uint32), observed.packed)
    try:
        decoded = decode_mask(changed, near, flags.shape)
    except MapError:
        assert not np.array_equal(counts, observed.counts)
        return
    assert decoded.max() <= 3
