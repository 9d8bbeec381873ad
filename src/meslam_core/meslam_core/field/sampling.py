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
        distributed about it, in pairs that mirror each other. So two or more always include one
        behind it, where it is seen to be solid, and yet lie evenly about it: more of them behind
        than before would draw the surface of noisy measurements towards the camera.
    """
    rays, device = len(measured), measured.device
    strata = torch.arange(config.free_samples, device=device)
    jitter = torch.rand(rays, config.free_samples, generator=generator, device=device)
    free_end = (measured - 2.0 * config.surface_sigma_m).clamp(min=0.02)
    free = (strata + jitter) / config.free_samples * free_end[:, None]
    count = (config.surface_samples + 1) // 2
    pairs = torch.randn(rays, count, generator=generator, device=device)
    offsets = torch.stack([pairs, -pairs], dim=2).flatten(1)[:, : config.surface_samples]
    offsets = offsets * config.surface_sigma_m
    near = (measured[:, None] + offsets).clamp(min=0.01)
    return torch.cat([free, near], dim=1).sort(dim=1).values
