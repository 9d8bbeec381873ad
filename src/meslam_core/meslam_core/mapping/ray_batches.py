"""Losses and gradients of one training step after another, by torch or by the compiled kernel."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import MappingConfig
from meslam_core.field.kernel import KernelField
from meslam_core.field.rendering import render
from meslam_core.field.sampling import sample_distances
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.losses import ray_losses
from meslam_core.mapping.ray_draws import RayDraws
from meslam_core.regions.region import Region
from meslam_core.se3 import inverse

Floats = NDArray[np.float32]


class RayBatches(Protocol):
    """The rays of several steps, ready to be trained on."""

    def train(self, number: int, rotations: Floats, translations: Floats) -> tuple[Floats, Floats]:
        """Add a step's gradients to those of the region's network.

        Args:
            number: of the step.
            rotations, translations: (P, 3, 3) and (P, 3) T_map_camera [m]: the draws' keyframes
                first, the current frame last.

        Returns:
            Weighted losses of the rays (R + C, 3): signed distance, depth, colour; and the
            gradient of their mean by the poses' twists (P, 6).
        """
        ...


class CompiledBatches:
    """On the compiled kernel; everything is gathered at once, for all steps.

    Args:
        field: the region's network.
        region: what is trained.
        keyframes: whose rays were drawn; on the CPU.
        draws: of the steps' rays.
        current: of the current frame, for the draws that take some of it.
        config: numbers of samples, weights of the losses.
    """

    def __init__(
        self,
        field: KernelField,
        region: Region,
        keyframes: KeyframeStore,
        draws: RayDraws,
        current: Rays | None,
        config: MappingConfig,
    ) -> None:
        self._field = field
        self._config = config
        self._draws = draws
        to_region = inverse(region.T_map_region)[:3] / region.half_side_m
        self._to_region = np.ascontiguousarray(to_region, dtype=np.float32)
        directions, distances, colors = keyframes.ray_arrays(
            draws.keyframes[draws.chosen], draws.slots
        )
        scaled = np.multiply(colors, np.float32(1.0 / 255.0), dtype=np.float32)
        if current is not None:
            slots = draws.current_slots
            directions = np.concatenate([directions, current.directions.numpy()[slots]], axis=1)
            distances = np.concatenate([distances, current.distances_m.numpy()[slots]], axis=1)
            scaled = np.concatenate([scaled, current.colors.numpy()[slots]], axis=1)
        self._directions, self._distances, self._colors = directions, distances, scaled
        self._pose = np.empty(distances.shape, np.int64)
        self._pose[:, : draws.chosen.shape[1]] = draws.chosen

    def train(self, number: int, rotations: Floats, translations: Floats) -> tuple[Floats, Floats]:
        pose = self._pose[number]
        pose[self._draws.chosen.shape[1] :] = len(rotations) - 1
        return self._field.train_posed_rays(
            rotations,
            translations,
            pose,
            self._directions[number],
            self._distances[number],
            self._colors[number],
            self._to_region,
            self._config,
            int(self._draws.seeds[number]),
        )


class TorchBatches:
    """On torch, on the keyframes' device, in the steps of the paper.

    Args:
        region, keyframes, draws, current, config: as `CompiledBatches` has them.
        generator: of the samples, on the device.
        with_poses: whether the poses' gradient is wanted; else it is zero.
    """

    def __init__(
        self,
        region: Region,
        keyframes: KeyframeStore,
        draws: RayDraws,
        current: Rays | None,
        config: MappingConfig,
        generator: torch.Generator,
        with_poses: bool,
    ) -> None:
        self._region = region
        self._keyframes = keyframes
        self._current = current
        self._config = config
        self._generator = generator
        self._with_poses = with_poses
        device = keyframes.device
        self._numbers = torch.from_numpy(draws.keyframes).to(device)
        self._chosen = torch.from_numpy(draws.chosen).to(device)
        self._slots = torch.from_numpy(draws.slots).to(device)
        self._current_slots = torch.from_numpy(draws.current_slots)

    def train(self, number: int, rotations: Floats, translations: Floats) -> tuple[Floats, Floats]:
        device = self._keyframes.device
        rays, pose = self._rays(number, len(rotations))
        twists = torch.zeros(len(rotations), 6, device=device, requires_grad=self._with_poses)
        ray_twists = twists[pose]
        turned = torch.from_numpy(rotations).to(device)[pose] @ rays.directions[:, :, None]
        directions = turned[..., 0] + torch.linalg.cross(ray_twists[:, 3:], turned[..., 0])
        origins = torch.from_numpy(translations).to(device)[pose] + ray_twists[:, :3]
        losses = self._losses(rays, origins, directions)
        losses.sum(dim=1).mean().backward()  # type: ignore[no-untyped-call]
        gradient = twists.grad if twists.grad is not None else torch.zeros_like(twists)
        return losses.detach().cpu().numpy(), gradient.cpu().numpy()

    def _rays(self, number: int, poses: int) -> tuple[Rays, torch.Tensor]:
        """A step's rays and the number of each ray's pose."""
        chosen = self._chosen[number]
        rays = self._keyframes.rays(self._numbers[chosen], self._slots[number])
        if self._current is None:
            return rays, chosen
        slots, current = self._current_slots[number], self._current
        taken = Rays(current.directions[slots], current.distances_m[slots], current.colors[slots])
        taken = taken.to(self._keyframes.device)
        joined = Rays(
            torch.cat([rays.directions, taken.directions]),
            torch.cat([rays.distances_m, taken.distances_m]),
            torch.cat([rays.colors, taken.colors]),
        )
        return joined, torch.cat([chosen, chosen.new_full((len(taken),), poses - 1)])

    def _losses(self, rays: Rays, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        field, config = self._region.field, self._config
        along = sample_distances(rays.distances_m, config, self._generator)
        points = origins[:, None] + along[..., None] * directions[:, None]
        values = field.evaluate(self._region.to_region(points.reshape(-1, 3)))
        values = values.reshape(*along.shape, 4)
        rendering = render(values[..., 0], values[..., 1:], along, field.config, opaque_end=True)
        losses = ray_losses(
            values[..., 0], along, rendering, rays.distances_m, rays.colors, field.config, config
        )
        return torch.stack([losses.distance, losses.depth, losses.color], dim=1)
