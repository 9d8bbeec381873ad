"""Losses of the joint optimisation (Sec. II-B, with direct supervision of the density)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from meslam_core.config import FieldConfig, MappingConfig
from meslam_core.field.rendering import Rendering, surface_offset_m


def depth_confidence(depth_m: torch.Tensor) -> torch.Tensor:
    """Weight of a depth measurement: stereo and Kinect noise grow with the square of depth."""
    return (1.0 / (0.5 + 0.125 * depth_m**2)).clamp(max=1.5)


def target_distance_field(
    along: torch.Tensor, measured: torch.Tensor, config: FieldConfig
) -> torch.Tensor:
    """f* (R, S) = clip((t - D + b) / tr, -1, 1) of samples at distance t on rays that end at D."""
    offset = surface_offset_m(config)
    return ((along - measured[:, None] + offset) / config.truncation_m).clamp(-1.0, 1.0)


@dataclass(frozen=True)
class RayLosses:
    """Weighted losses a ray, each (R,): signed distance, rendered depth, rendered colour."""

    distance: torch.Tensor
    depth: torch.Tensor
    color: torch.Tensor

    @property
    def total(self) -> torch.Tensor:
        """(R,) sum of the three."""
        return self.distance + self.depth + self.color


def ray_losses(
    distance_field: torch.Tensor,
    along: torch.Tensor,
    rendering: Rendering,
    measured: torch.Tensor,
    color: torch.Tensor,
    field: FieldConfig,
    mapping: MappingConfig,
) -> RayLosses:
    """Losses of rays against their measurements.

    Args:
        distance_field: (R, S) network output f at the samples.
        along: (R, S) distances of the samples [m].
        rendering: of the same samples.
        measured: (R,) distance of the measured surface along the ray [m].
        color: (R, 3) measured colour in [0, 1].
        field, mapping: scales and weights.
    """
    confidence = depth_confidence(measured)
    target = target_distance_field(along, measured, field)
    distance = (distance_field - target).abs().mean(dim=1) * confidence
    depth = (rendering.distance_m - measured).abs().clamp(max=mapping.depth_clip_m)
    photometric = (rendering.color - color).abs().mean(dim=1)
    return RayLosses(
        mapping.distance_weight * distance,
        mapping.depth_weight * depth,
        mapping.color_weight * photometric,
    )
