"""Volume rendering of colour, depth and depth variance along rays (iMAP, Eq. 2 to 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from meslam_core.config import FieldConfig

MAX_OPTICAL_DEPTH = 30.0


@dataclass(frozen=True)
class Rendering:
    """Rendered rays.

    Attributes:
        color: (R, 3) in [0, 1].
        distance_m: (R,) expected distance along the ray [m].
        variance_m2: (R,) variance of that distance [m^2].
        opacity: (R,) probability that the ray ends within its samples.
    """

    color: torch.Tensor
    distance_m: torch.Tensor
    variance_m2: torch.Tensor
    opacity: torch.Tensor


def surface_offset_m(config: FieldConfig) -> float:
    """How far before the surface f crosses zero, so that rendered depth is unbiased [m].

    With density alpha * relu(s / tr) growing linearly behind the crossing, the expected depth of
    a ray lies sqrt(pi * tr / (2 alpha)) behind it (the mean of a Rayleigh distribution).
    """
    return math.sqrt(math.pi * config.truncation_m / (2.0 * config.density_scale))


def surface_level(config: FieldConfig) -> float:
    """The value of f on the surface."""
    return surface_offset_m(config) / config.truncation_m


def render(
    distance_field: torch.Tensor,
    color: torch.Tensor,
    along: torch.Tensor,
    config: FieldConfig,
    opaque_end: bool = False,
) -> Rendering:
    """Render rays from samples.

    Args:
        distance_field: (R, S) network output f.
        color: (R, S, 3) in [0, 1].
        along: (R, S) ascending distances of the samples [m].
        config: density scale [1/m] and truncation [m].
        opaque_end: what passes through the other samples ends in the last one, as light does on
            a ray that was measured. Without it a ray whose few samples let light through is
            rendered too dark, and training answers by drawing the surface nearer.
    """
    density = config.density_scale * torch.relu(distance_field)
    spacing = torch.diff(along, dim=1)
    spacing = torch.cat([spacing, torch.full_like(along[:, :1], config.truncation_m)], dim=1)
    optical_depth = (density * spacing).clamp(max=MAX_OPTICAL_DEPTH)
    if opaque_end:
        end = torch.full_like(optical_depth[:, :1], MAX_OPTICAL_DEPTH)
        optical_depth = torch.cat([optical_depth[:, :-1], end], dim=1)
    passed = torch.cumsum(optical_depth, dim=1) - optical_depth
    weights = torch.exp(-passed) * -torch.expm1(-optical_depth)
    opacity = weights.sum(dim=1)
    normalizer = opacity.clamp(min=1e-4)
    distance = (weights * along).sum(dim=1) / normalizer
    deviation = along - distance[:, None].detach()
    variance = (weights * deviation**2).sum(dim=1) / normalizer
    rendered = (weights[..., None] * color).sum(dim=1)
    return Rendering(rendered, distance, variance, opacity)
