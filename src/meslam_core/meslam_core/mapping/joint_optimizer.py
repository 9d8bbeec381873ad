"""Joint optimisation of a region's network and the poses of its keyframes (Sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from meslam_core.config import MappingConfig
from meslam_core.field.kernel import KernelField
from meslam_core.field.model import ADAM_BETAS, ADAM_EPSILON
from meslam_core.field.rendering import render
from meslam_core.field.sampling import sample_distances
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.mapping.losses import RayLosses, ray_losses
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, torch_exp

LOSS_MEMORY = 0.8
# Odometry that disagrees by more than this [m, rad] is taken for a failure and lets go.
LINK_OUTLIER = 0.03


@dataclass(frozen=True)
class StepLosses:
    """Mean weighted losses of one or several steps, without unit."""

    distance: float = 0.0
    depth: float = 0.0
    color: float = 0.0

    @property
    def total(self) -> float:
        """Their sum."""
        return self.distance + self.depth + self.color


class JointOptimizer:
    """Trains one region at a time on keyframes and on the current frame.

    Poses are optimised as small twists about the camera centre that are folded into the poses
    after every step, so that their derivative is always taken at zero.

    Args:
        keyframes: all keyframes; their poses are refined in place. The first stays fixed: it
            holds the map in its frame.
        config: numbers of rays, samples and steps, learning rates, loss weights.
        seed: of the random choice of rays and samples.
    """

    def __init__(self, keyframes: KeyframeStore, config: MappingConfig, seed: int = 0) -> None:
        self.keyframes = keyframes
        self.config = config
        self.device = keyframes.device
        self._generator = torch.Generator(device=self.device).manual_seed(seed)
        self._seeds = np.random.default_rng(seed)
        self._pose_steps = 0
        self._first_moment = torch.zeros(0, 6, device=self.device)
        self._second_moment = torch.zeros(0, 6, device=self.device)

    def train(
        self,
        region: Region,
        steps: int,
        current: Rays | None = None,
        T_map_current: Pose | None = None,
        refine_poses: bool = True,
        rate_factor: float = 1.0,
    ) -> StepLosses:
        """Run `steps` steps on a region and return their mean losses.

        Args:
            region: whose network is trained.
            steps: number of Adam steps.
            current: rays of the current frame to mix in, with their pose.
            T_map_current: (4, 4) pose of the current frame, held fixed.
            refine_poses: whether keyframe poses move.
            rate_factor: of the weights' learning rate.
        """
        sums = torch.zeros(3, device=self.device)
        done = 0
        for _ in range(steps):
            losses = self._step(region, current, T_map_current, refine_poses, rate_factor)
            sums += losses
            done += 1
        means = (sums / max(done, 1)).tolist()
        return StepLosses(*means)

    def _step(
        self,
        region: Region,
        current: Rays | None,
        T_map_current: Pose | None,
        refine_poses: bool,
        rate_factor: float,
    ) -> torch.Tensor:
        chosen = self._choose_keyframes(region)
        slots = torch.randint(
            self.keyframes.rays_per_keyframe,
            chosen.shape,
            generator=self._generator,
            device=self.device,
        )
        rays = self.keyframes.rays(chosen, slots)
        with_current = current is not None and T_map_current is not None
        if with_current and self.config.current_rays:
            assert current is not None
            rays = self._with_current(rays, current)
        else:
            T_map_current = None
        if isinstance(region.field, KernelField):
            losses, gradient = self._compiled_losses(
                region.field, region, rays, chosen, T_map_current
            )
        else:
            losses, gradient = self._torch_losses(region, rays, chosen, T_map_current, refine_poses)
        if region.field.step(self.config.learning_rate * rate_factor) and refine_poses:
            self._move_poses(gradient)
        self._remember(chosen, losses.sum(dim=1)[: len(chosen)])
        return losses.mean(dim=0)

    def _torch_losses(
        self,
        region: Region,
        rays: Rays,
        chosen: torch.Tensor,
        T_map_current: Pose | None,
        refine_poses: bool,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Losses (R, 3) and the keyframes' twist gradients (K, 6); the weights keep theirs."""
        twists = torch.zeros(len(self.keyframes), 6, device=self.device, requires_grad=refine_poses)
        count = len(chosen)
        rotations, origins = self.keyframes.rotations[chosen], self.keyframes.translations[chosen]
        directions = (rotations @ rays.directions[:count, :, None])[..., 0]
        ray_twists = twists[chosen]
        directions = directions + torch.linalg.cross(ray_twists[:, 3:], directions)
        origins = origins + ray_twists[:, :3]
        if T_map_current is not None:
            pose = torch.from_numpy(T_map_current).float().to(self.device)
            directions = torch.cat([directions, rays.directions[count:] @ pose[:3, :3].T])
            origins = torch.cat([origins, pose[:3, 3].expand(len(rays) - count, 3)])
        losses = self._losses(region, rays, origins, directions)
        losses.total.mean().backward()  # type: ignore[no-untyped-call]
        gradient = twists.grad if twists.grad is not None else torch.zeros_like(twists)
        parts = [losses.distance, losses.depth, losses.color]
        return torch.stack(parts, dim=1).detach(), gradient

    def _compiled_losses(
        self,
        field: KernelField,
        region: Region,
        rays: Rays,
        chosen: torch.Tensor,
        T_map_current: Pose | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The same in one pass of the compiled kernel, which draws its own samples."""
        rotations, translations = self.keyframes.rotations, self.keyframes.translations
        pose = chosen.numpy()
        if T_map_current is not None:
            current = torch.from_numpy(T_map_current).float()
            rotations = torch.cat([rotations, current[None, :3, :3]])
            translations = torch.cat([translations, current[None, :3, 3]])
            added = np.full(len(rays) - len(chosen), len(self.keyframes), np.int64)
            pose = np.concatenate([pose, added])
        to_region = inverse(region.T_map_region)[:3] / region.half_side_m
        losses, gradient = field.train_posed_rays(
            np.ascontiguousarray(rotations.numpy()),
            np.ascontiguousarray(translations.numpy()),
            pose,
            rays.directions.numpy(),
            rays.distances_m.numpy(),
            rays.colors.numpy(),
            np.ascontiguousarray(to_region, dtype=np.float32),
            self.config,
            int(self._seeds.integers(2**31)),
        )
        return torch.from_numpy(losses), torch.from_numpy(gradient[: len(self.keyframes)].copy())

    def _choose_keyframes(self, region: Region) -> torch.Tensor:
        """Keyframe number of each ray: some from the latest, the rest by the root of the loss."""
        members = torch.tensor(region.keyframes, device=self.device)
        latest = round(self.config.rays * self.config.latest_share)
        weights = self.keyframes.losses[members].clamp(min=1e-4).sqrt()
        drawn = torch.multinomial(
            weights, self.config.rays - latest, replacement=True, generator=self._generator
        )
        return torch.cat([members[drawn], members[-1].expand(latest)])

    def _with_current(self, rays: Rays, current: Rays) -> Rays:
        """The rays, followed by some of the current frame."""
        count = self.config.current_rays
        slots = torch.randint(len(current), (count,), generator=self._generator, device=self.device)
        return Rays(
            torch.cat([rays.directions, current.directions[slots]]),
            torch.cat([rays.distances_m, current.distances_m[slots]]),
            torch.cat([rays.colors, current.colors[slots]]),
        )

    def _losses(
        self, region: Region, rays: Rays, origins: torch.Tensor, directions: torch.Tensor
    ) -> RayLosses:
        along = sample_distances(rays.distances_m, self.config, self._generator)
        points = origins[:, None] + along[..., None] * directions[:, None]
        values = region.field.evaluate(region.to_region(points.reshape(-1, 3)))
        values = values.reshape(*along.shape, 4)
        rendering = render(values[..., 0], values[..., 1:], along, region.field.config)
        return ray_losses(
            values[..., 0],
            along,
            rendering,
            rays.distances_m,
            rays.colors,
            region.field.config,
            self.config,
        )

    def _move_poses(self, gradient: torch.Tensor) -> None:
        """One Adam step of all poses, folded into them."""
        if not bool(torch.isfinite(gradient).all()):
            return
        self._grow_moments()
        if self.config.odometry_weight > 0.0:
            gradient += self.config.odometry_weight * self._link_gradient()
        gradient[0] = 0.0
        beta1, beta2 = ADAM_BETAS
        self._pose_steps += 1
        n = self._pose_steps
        self._first_moment.mul_(beta1).add_(gradient, alpha=1 - beta1)
        self._second_moment.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        mean = self._first_moment / (1 - beta1**n)
        spread = (self._second_moment / (1 - beta2**n)).sqrt() + ADAM_EPSILON
        rate = self.config.pose_learning_rate / (1.0 + n / self.config.pose_decay_steps)
        step = torch_exp(-rate * mean / spread)
        # The twist turns about the camera centre: translation and rotation move on their own.
        self.keyframes.translations.add_(-rate * (mean / spread)[:, :3])
        rotations = step[:, :3, :3] @ self.keyframes.rotations
        u, _, vt = torch.linalg.svd(rotations)
        self.keyframes.rotations.copy_(u @ vt)

    def _link_gradient(self) -> torch.Tensor:
        """Gradient (K, 6) of half the squared deviations from odometry between keyframes."""
        rotations, translations = self.keyframes.rotations, self.keyframes.translations
        link_rotations, link_translations, weights = (part[1:] for part in self.keyframes.links)
        arms = (rotations[:-1] @ link_translations[..., None])[..., 0]
        moved = translations[1:] - translations[:-1] - arms
        turned = rotations[1:] @ (rotations[:-1] @ link_rotations).transpose(1, 2)
        turned = 0.5 * torch.stack(
            [
                turned[:, 2, 1] - turned[:, 1, 2],
                turned[:, 0, 2] - turned[:, 2, 0],
                turned[:, 1, 0] - turned[:, 0, 1],
            ],
            dim=1,
        )
        moved = moved * (weights * _outlier_weight(moved))[:, None]
        turned = turned * (weights * _outlier_weight(turned))[:, None]
        gradient = torch.zeros(len(self.keyframes), 6, device=self.device)
        gradient[1:, :3] += moved
        gradient[:-1, :3] -= moved
        gradient[1:, 3:] += turned
        gradient[:-1, 3:] -= turned + torch.linalg.cross(arms, moved)
        return gradient

    def _grow_moments(self) -> None:
        missing = len(self.keyframes) - len(self._first_moment)
        if missing:
            zeros = torch.zeros(missing, 6, device=self.device)
            self._first_moment = torch.cat([self._first_moment, zeros])
            self._second_moment = torch.cat([self._second_moment, zeros])

    def _remember(self, chosen: torch.Tensor, losses: torch.Tensor) -> None:
        """Update the running loss of the keyframes that took part."""
        sums = torch.zeros(len(self.keyframes), device=self.device)
        counts = torch.zeros_like(sums)
        sums.index_add_(0, chosen, losses)
        counts.index_add_(0, chosen, torch.ones_like(losses))
        seen = (counts > 0) & torch.isfinite(sums)
        mean = sums[seen] / counts[seen]
        self.keyframes.losses[seen] = (
            LOSS_MEMORY * self.keyframes.losses[seen] + (1 - LOSS_MEMORY) * mean
        )


def _outlier_weight(error: torch.Tensor) -> torch.Tensor:
    """Geman-McClure weights (K,) of errors (K, 3)."""
    return (1.0 + (error * error).sum(dim=1) / LINK_OUTLIER**2) ** -2
