"""Gaussian positional embedding with a phase that makes it movable."""

from __future__ import annotations

import torch


class GaussianEncoding(torch.nn.Module):
    """sin(B x + phase) with Gaussian frequencies B (Tancik et al. 2020, as in the paper).

    The phase lets a field be re-expressed about another origin without any change of what it
    says: sin(B (x + d) + phase) == sin(B x + (phase + B d)). A new region inherits a
    neighbour's weights that way and continues its map exactly.

    Args:
        features: number of sine features E.
        sigma: standard deviation of B; coordinates are region coordinates in [-1, 1].
        generator: source of the random frequencies and phases.
    """

    def __init__(self, features: int, sigma: float, generator: torch.Generator) -> None:
        super().__init__()
        frequencies = torch.randn(features, 3, generator=generator) * sigma
        phases = (torch.rand(features, generator=generator) * 2 - 1) * torch.pi
        self.frequencies = torch.nn.Parameter(frequencies)
        self.phases = torch.nn.Parameter(phases)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """Features (N, E) of points (N, 3) in region coordinates."""
        return torch.sin(points @ self.frequencies.T + self.phases)
