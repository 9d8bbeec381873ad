"""Volume rendering: known answers, no bias of the depth, gradients, a converged field."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meslam_core.config import FieldConfig
from meslam_core.field.rendering import (
    render,
    surface_level,
    surface_offset_m,
)
from meslam_core.mapping.keyframe_policy import KeyframePolicy
from meslam_core.mapping.keyframes import rays_at
from meslam_core.mapping.losses import target_distance_field
from meslam_core.tracking.pixels import trusted_pixels

CONFIG = FieldConfig()


def plane(distances: torch.Tensor, samples: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples of the ideal field along rays that meet a surface at `distances`."""
    near, far = distances - 0.3, distances + 0.15
    along = near[:, None] + torch.linspace(0, 1, samples) * (far - near)[:, None]
    return target_distance_field(along, distances, CONFIG), along


def test_a_plane_is_rendered_at_its_depth_without_bias():
    distances = torch.linspace(0.5, 4.0, 50)
    field, along = plane(distances)
    rendering = render(field, torch.zeros(*field.shape, 3), along, CONFIG)
    error = rendering.distance_m - distances
    assert error.abs().max() < 1.5e-3
    # Without the offset the depth would lie this far behind the plane.
    assert error.abs().max() < 0.1 * surface_offset_m(CONFIG)
    assert (rendering.opacity > 0.999).all()


@pytest.mark.parametrize(("scale", "truncation"), [(100.0, 0.1), (500.0, 0.05), (2000.0, 0.2)])
def test_the_depth_is_unbiased_for_every_density_scale(scale, truncation):
    config = FieldConfig(density_scale=scale, truncation_m=truncation)
    distance = torch.tensor([2.0])
    along = torch.linspace(1.5, 2.5, 4000)[None]
    field = target_distance_field(along, distance, config)
    rendering = render(field, torch.zeros(1, 4000, 3), along, config)
    # Saturation at the truncation distance cuts the Rayleigh distribution's tail.
    assert float(rendering.distance_m - 2.0) == pytest.approx(0.0, abs=0.02 * truncation)


def test_the_spread_of_the_depth_is_that_of_a_rayleigh_distribution():
    field, along = plane(torch.tensor([2.0]), samples=2000)
    rendering = render(field, torch.zeros(1, 2000, 3), along, CONFIG)
    offset = surface_offset_m(CONFIG)
    expected = (4 - np.pi) / np.pi * offset**2
    assert float(rendering.variance_m2) == pytest.approx(expected, rel=0.05)


def test_the_surface_level_is_the_fields_value_on_the_surface():
    distance = torch.tensor([1.7])
    on_surface = target_distance_field(distance[None], distance, CONFIG)
    assert float(on_surface) == pytest.approx(surface_level(CONFIG), abs=1e-5)


def test_an_opaque_surface_shows_its_colour_and_hides_what_is_behind():
    field, along = plane(torch.tensor([1.0]))
    color = torch.zeros(1, 400, 3)
    behind = along[0] > 1.1
    color[0, ~behind] = torch.tensor([0.2, 0.5, 0.9])
    color[0, behind] = 1.0
    rendering = render(field, color, along, CONFIG)
    torch.testing.assert_close(rendering.color[0], torch.tensor([0.2, 0.5, 0.9]), atol=5e-3, rtol=0)


def test_an_empty_ray_is_transparent():
    along = torch.linspace(0.1, 3.0, 50)[None]
    rendering = render(torch.full((1, 50), -1.0), torch.ones(1, 50, 3), along, CONFIG)
    assert float(rendering.opacity) == 0.0
    assert torch.isfinite(rendering.distance_m).all()
    torch.testing.assert_close(rendering.color, torch.zeros(1, 3))


def test_a_measured_ray_is_opaque_at_its_end():
    along = torch.linspace(0.1, 3.0, 50)[None]
    empty = torch.full((1, 50), -1.0)
    rendering = render(empty, torch.ones(1, 50, 3), along, CONFIG, opaque_end=True)
    assert float(rendering.opacity) == pytest.approx(1.0)
    assert float(rendering.distance_m) == pytest.approx(3.0)
    torch.testing.assert_close(rendering.color, torch.ones(1, 3))


def test_extreme_outputs_stay_finite():
    along = torch.linspace(0.1, 3.0, 9)[None]
    field = torch.tensor([[1e4, -1e4, 3e3, 1e6, -1.0, 0.0, 1e8, 5.0, 1.0]], requires_grad=True)
    rendering = render(field, torch.ones(1, 9, 3), along, CONFIG)
    (rendering.distance_m + rendering.variance_m2 + rendering.color.sum(-1)).sum().backward()
    assert torch.isfinite(rendering.distance_m).all()
    assert torch.isfinite(field.grad).all()


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    along = torch.rand(4, 7, generator=generator, dtype=torch.float64).sort(dim=1).values + 0.5
    field = torch.randn(4, 7, generator=generator, dtype=torch.float64) * 0.05 + 0.02
    color = torch.rand(4, 7, 3, generator=generator, dtype=torch.float64)
    field.requires_grad_(True)
    color.requires_grad_(True)

    def outputs(f: torch.Tensor, c: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rendering = render(f, c, along, CONFIG)
        return rendering.color, rendering.distance_m, rendering.opacity

    assert torch.autograd.gradcheck(outputs, (field, color), eps=1e-8, atol=1e-5)


@pytest.mark.parametrize("number", [5, 35])
def test_a_converged_field_renders_the_depth_image_of_a_view_it_has_not_seen(mapped_room, number):
    frame = mapped_room.frame(number)
    rows, columns = np.nonzero(trusted_pixels(frame.depth_m, mapped_room.config.sensor))
    rays = rays_at(frame, rows[::20], columns[::20])
    policy = KeyframePolicy(mapped_room.config.keyframes, mapped_room.config.field)
    rendered = policy.rendered_distances(mapped_room.region, mapped_room.poses[number], rays)
    error = rendered - rays.distances_m.numpy()
    assert np.median(np.abs(error)) < 0.008
    assert np.abs(np.median(error)) < 0.004
    assert np.percentile(np.abs(error), 90) < 0.03
