"""The losses of the joint optimisation."""

from __future__ import annotations

import math

import pytest
import torch

from meslam_core.config import FieldConfig, MappingConfig
from meslam_core.field.rendering import Rendering, render, surface_offset_m
from meslam_core.mapping.losses import (
    depth_confidence,
    ray_losses,
    target_distance_field,
)

FIELD, MAPPING = FieldConfig(), MappingConfig()


def test_the_target_is_a_truncated_distance_before_and_behind_the_surface():
    measured = torch.tensor([2.0])
    along = torch.tensor([[0.5, 1.93, 2.0, 2.03, 2.5]])
    target = target_distance_field(along, measured, FIELD)[0]
    offset = math.sqrt(math.pi * 0.1 / 1000.0)
    assert surface_offset_m(FIELD) == pytest.approx(offset)
    expected = [-1.0, (-0.07 + offset) / 0.1, offset / 0.1, (0.03 + offset) / 0.1, 1.0]
    torch.testing.assert_close(target, torch.tensor(expected), atol=1e-5, rtol=0)


def test_confidence_falls_with_the_square_of_depth():
    confidence = depth_confidence(torch.tensor([0.3, 1.0, 2.0, 4.0]))
    torch.testing.assert_close(confidence, torch.tensor([1.5, 1.5, 1.0, 0.4]))


def rendered(distance_m: float, color: float = 0.5) -> Rendering:
    return Rendering(
        torch.full((1, 3), color), torch.tensor([distance_m]), torch.zeros(1), torch.ones(1)
    )


def test_a_perfect_prediction_costs_nothing():
    measured, color = torch.tensor([2.0]), torch.full((1, 3), 0.5)
    along = torch.linspace(1.0, 2.1, 30)[None]
    target = target_distance_field(along, measured, FIELD)
    losses = ray_losses(target, along, rendered(2.0), measured, color, FIELD, MAPPING)
    torch.testing.assert_close(losses.total, torch.zeros(1))


def test_every_part_is_weighted_and_the_depth_is_clipped():
    measured, color = torch.tensor([2.0]), torch.full((1, 3), 0.2)
    along = torch.linspace(1.0, 2.1, 30)[None]
    target = target_distance_field(along, measured, FIELD)
    losses = ray_losses(target + 0.1, along, rendered(3.0), measured, color, FIELD, MAPPING)
    # |f - f*| = 0.1 at confidence 1, depth error clipped, |C - C*| = 0.3
    assert losses.distance.item() == pytest.approx(MAPPING.distance_weight * 0.1, rel=1e-4)
    assert losses.depth.item() == pytest.approx(MAPPING.depth_weight * MAPPING.depth_clip_m)
    assert losses.color.item() == pytest.approx(MAPPING.color_weight * 0.3)
    assert losses.total.item() == pytest.approx(
        sum(part.item() for part in (losses.distance, losses.depth, losses.color))
    )


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(1)
    measured = torch.tensor([1.0, 1.5], dtype=torch.float64)
    along = measured[:, None] + torch.linspace(-0.2, 0.06, 9, dtype=torch.float64)
    field = target_distance_field(along, measured, FIELD)
    field = field + 0.05 * torch.randn(2, 9, generator=generator, dtype=torch.float64)
    color = torch.rand(2, 9, 3, generator=generator, dtype=torch.float64)
    seen = torch.rand(2, 3, generator=generator, dtype=torch.float64)

    def total(f: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        rendering = render(f, c, along, FIELD)
        return ray_losses(f, along, rendering, measured, seen, FIELD, MAPPING).total

    inputs = (field.requires_grad_(True), color.requires_grad_(True))
    assert torch.autograd.gradcheck(total, inputs, eps=1e-8, atol=1e-5)
