"""The equations are the same, whoever sums them."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from meslam_core.config import TrackingConfig
from meslam_core.field.alignment import AlignmentSettings
from meslam_core.field.kernel import KernelField
from meslam_core.field.model import TorchField
from meslam_core.mapping.keyframes import rays_at
from meslam_core.se3 import exp, inverse
from meslam_core.tracking.field_equations import field_equations
from meslam_core.tracking.field_tracker import FieldTracker
from meslam_core.tracking.pixels import choose_pixels, trusted_pixels

SETTINGS = AlignmentSettings(
    to_map=exp(np.array([0.0, 0.0, 0.0, 0.3, -0.5, 0.2]))[:3, :3] / 1.6,
    surface_level=0.1,
    saturation=0.95,
    min_slope=1.0,
    huber_m=0.03,
    color_weight=0.15,
)


@pytest.fixture
def kernel_field(mapped_room) -> KernelField:
    if not isinstance(mapped_room.region.field, KernelField):
        pytest.skip("the compiled kernel is not installed")
    return mapped_room.region.field


@pytest.mark.parametrize("color_weight", [0.0, 0.15])
def test_the_compiled_sums_are_those_of_the_probed_field(kernel_field, color_weight):
    settings = dataclasses.replace(SETTINGS, color_weight=color_weight)
    generator = np.random.default_rng(0)
    points = generator.uniform(-0.9, 0.9, (800, 3)).astype(np.float32)
    arms = generator.normal(size=(800, 3)).astype(np.float32)
    luma = generator.uniform(size=800).astype(np.float32)
    weights = generator.uniform(0.0, 1.5, 800).astype(np.float32)
    weights[::9] = 0.0
    probed = SimpleNamespace(probe=kernel_field.probe)
    compiled = field_equations(kernel_field, points, arms, luma, weights, settings)
    expected = field_equations(probed, points, arms, luma, weights, settings)
    assert 50 < np.count_nonzero(expected.usable) < 750
    np.testing.assert_array_equal(compiled.usable, expected.usable)
    np.testing.assert_allclose(compiled.distance_m, expected.distance_m, rtol=1e-4, atol=1e-6)
    for name in ("information", "gradient"):
        ours, theirs = getattr(compiled, name), getattr(expected, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5 * np.abs(theirs).max())


def test_a_frame_is_aligned_alike_on_either_field(mapped_room, kernel_field):
    reference = TorchField(kernel_field.config)
    reference.load_flat(kernel_field.flat())
    frame = mapped_room.frame(15)
    pixels = trusted_pixels(frame.depth_m, mapped_room.config.sensor)
    rays = rays_at(frame, *choose_pixels(pixels, 1500, np.random.default_rng(0)))
    guess = mapped_room.poses[15].copy()
    guess[:3, 3] += [0.01, -0.012, 0.008]
    tracker = FieldTracker(TrackingConfig())
    regions = [
        mapped_room.region.viewed(f, mapped_room.region.mask) for f in (kernel_field, reference)
    ]
    first, second = (tracker.align(region, rays, guess) for region in regions)
    offset = inverse(first.T_map_camera) @ second.T_map_camera
    assert np.abs(offset - np.eye(4)).max() < 1e-3
    assert first.residual_m == pytest.approx(second.residual_m, abs=2e-4)
    assert first.inlier_ratio == pytest.approx(second.inlier_ratio, abs=0.01)
    assert first.observed_ratio == pytest.approx(second.observed_ratio, abs=0.01)
    costs = [tracker.robust_cost(region, rays, guess) for region in regions]
    assert costs[0] == pytest.approx(costs[1], abs=0.01)
