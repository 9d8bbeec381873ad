"""Where a ray is sampled: free space, and closely around the measured surface."""

from __future__ import annotations

import torch

from meslam_core.config import MappingConfig


def sample_distances(
    measured: torch.Tensor, config: MappingConfig, generator: torch.Generator
) -> torch.Tensor:
    """Sorted distances along rays.

    Args:
        measured: (R,) distance of the surface along each ray [m].
        config: numbers of samples and their spread.
        generator: of the random numbers, on the device of `measured`.

    Returns:
        (R, S) ascending distances [m], S = free_samples + surface_samples. Free-space samples
        are stratified between the camera and the surface; surface samples are normally
        distributed about it, the last one forced behind it so that it is seen to be solid.
    """
    rays, device = len(measured), measured.device
    strata = torch.arange(config.free_samples, device=device)
    jitter = torch.rand(rays, config.free_samples, generator=generator, device=device)
    free_end = (measured - 2.0 * config.surface_sigma_m).clamp(min=0.02)
    free = (strata + jitter) / config.free_samples * free_end[:, None]
    offsets = torch.randn(rays, config.surface_samples, generator=generator, device=device)
    offsets = offsets * config.surface_sigma_m
    offsets[:, -1] = offsets[:, -1].abs()
    near = (measured[:, None] + offsets).clamp(min=0.01)
    return torch.cat([free, near], dim=1).sort(dim=1).values
