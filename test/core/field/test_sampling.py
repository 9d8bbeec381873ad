"""Samples along rays."""

from __future__ import annotations

import pytest
import torch

from meslam_core.config import MappingConfig
from meslam_core.field.sampling import sample_distances

CONFIG = MappingConfig()


@pytest.fixture
def measured():
    return torch.linspace(0.3, 5.0, 400)


def samples(measured: torch.Tensor, config: MappingConfig = CONFIG, seed: int = 0) -> torch.Tensor:
    return sample_distances(measured, config, torch.Generator().manual_seed(seed))


def test_samples_ascend_in_front_of_the_camera(measured):
    along = samples(measured)
    assert along.shape == (400, CONFIG.free_samples + CONFIG.surface_samples)
    assert (along.diff(dim=1) >= 0).all()
    assert (along >= 0).all()
    assert (along[:, -1] < measured + 6 * CONFIG.surface_sigma_m).all()


def test_every_ray_has_a_sample_behind_its_surface(measured):
    assert (samples(measured)[:, -1] >= measured).all()


def test_free_space_is_covered_stratum_by_stratum(measured):
    config = MappingConfig(free_samples=8, surface_samples=1, surface_sigma_m=0.005)
    along = samples(measured, config)[:, :-1]
    end = measured - 2 * config.surface_sigma_m
    strata = (along / end[:, None] * 8).floor()
    torch.testing.assert_close(strata, torch.arange(8.0).expand_as(strata))


def test_surface_samples_spread_evenly_about_the_surface():
    measured = torch.full((20000,), 2.0)
    offsets = samples(measured)[:, CONFIG.free_samples :] - 2.0
    near = offsets[offsets.abs() < 5 * CONFIG.surface_sigma_m]
    assert near.std() == pytest.approx(CONFIG.surface_sigma_m, rel=0.06)
    assert near.mean() == pytest.approx(0.0, abs=0.02 * CONFIG.surface_sigma_m)


def test_very_near_surfaces_keep_samples_positive():
    along = samples(torch.full((100,), 0.03))
    assert (along > 0).all()
    assert (along.diff(dim=1) >= 0).all()


def test_the_generator_decides(measured):
    torch.testing.assert_close(samples(measured, seed=3), samples(measured, seed=3))
    assert not torch.equal(samples(measured, seed=3), samples(measured, seed=4))
