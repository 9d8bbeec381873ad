"""Which rays training takes."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.config import MappingConfig
from meslam_core.mapping.ray_draws import MOST_KEYFRAMES, RayDraws, draw_rays

CONFIG = MappingConfig(rays=200, current_rays=50, latest_share=0.2)


def drawn(losses: np.ndarray, steps: int = 20, seed: int = 0, current: int = 0) -> RayDraws:
    """Draws from keyframes 10, 11, ..."""
    members = 10 + np.arange(len(losses))
    generator = np.random.default_rng(seed)
    return draw_rays(generator, CONFIG, steps, members, losses.astype(np.float32), 64, current)


def shares(draws: list[RayDraws], keyframes: int) -> np.ndarray:
    """Each keyframe's share of the rays."""
    numbers = np.concatenate([d.keyframes[d.chosen].reshape(-1) for d in draws])
    return np.bincount(numbers - 10, minlength=keyframes) / len(numbers)


def test_rays_come_mostly_from_keyframes_that_fit_badly():
    share = shares([drawn(np.array([0.01, 1.0, 0.01, 0.01, 0.01]), steps=100, current=9)], 5)
    # Square roots of the losses: 10 against four times 1.
    assert share[1] == pytest.approx(0.8 * 10 / 14, abs=0.02)
    assert share[4] == pytest.approx(0.2 + 0.8 / 14, abs=0.02)


def test_the_latest_keyframe_is_the_last_member_whatever_its_number():
    draws = draw_rays(
        np.random.default_rng(0), CONFIG, 10, np.array([3, 9, 5]), np.ones(3, np.float32), 64, 9
    )
    numbers = draws.keyframes[draws.chosen]
    assert np.bincount(numbers.reshape(-1)).argmax() == 5
    assert np.mean(numbers == 5) == pytest.approx(0.2 + 0.8 / 3, abs=0.04)


def test_of_many_keyframes_each_comes_as_often_as_its_loss_asks():
    count = 3 * MOST_KEYFRAMES
    losses = np.random.default_rng(5).uniform(0.1, 2.0, count)
    draws = [drawn(losses, steps=5, seed=seed, current=9) for seed in range(150)]
    for draw in draws:
        assert len(draw.keyframes) <= MOST_KEYFRAMES
        assert draw.keyframes[-1] == 10 + count - 1
        assert (np.diff(draw.keyframes) > 0).all()
    share = shares(draws, count)
    assert share[-1] == pytest.approx(0.2, abs=0.01)
    expected = 0.8 * np.sqrt(losses) / np.sqrt(losses).sum()
    for group in np.array_split(np.argsort(losses[:-1]), 8):
        assert share[group].sum() == pytest.approx(expected[group].sum(), rel=0.06)


def test_indices_fit_what_they_index():
    draws = drawn(np.ones(4), current=70)
    assert len(draws) == 20
    assert draws.chosen.shape == draws.slots.shape == (20, 200)
    assert draws.current_slots.shape == (20, 50)
    for indices, size in ((draws.chosen, 4), (draws.slots, 64), (draws.current_slots, 70)):
        assert indices.min() == 0
        assert indices.max() == size - 1
    assert len(set(draws.seeds.tolist())) == 20


def test_no_current_frame_no_current_rays_and_no_keyframe_before_the_others():
    draws = drawn(np.ones(4), steps=100)
    assert draws.current_slots.shape == (100, 0)
    assert shares([draws], 4) == pytest.approx(np.full(4, 0.25), abs=0.01)


def test_the_generator_decides():
    for name in ("chosen", "slots", "seeds"):
        first, again, other = (getattr(drawn(np.ones(4), seed=s), name) for s in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first, other)
