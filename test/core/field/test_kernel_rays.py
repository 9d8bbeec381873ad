"""The kernel's training on rays and its normal equations against torch and numpy in float64."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig, MappingConfig
from meslam_core.field import kernel
from meslam_core.field.alignment import AlignmentSettings
from meslam_core.field.network import FieldNetwork
from meslam_core.field.rendering import render, surface_level
from meslam_core.field.sampling import sample_distances
from meslam_core.mapping.losses import ray_losses

ISAS = kernel.available_isas()
if not ISAS:
    pytest.skip(kernel.unavailable_reason(), allow_module_level=True)

SINGLE_PRECISION = {"avx512", "avx2", "portable"}
MAPPING = MappingConfig()


def tolerance(isa: str) -> float:
    """A loss's absolute value may switch its sign in a few samples, so not quite 1e-4."""
    return 1e-3 if isa in SINGLE_PRECISION else 0.15


def error(actual: NDArray, expected: NDArray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


class Rays:
    """Random rays, of which some see air, some a wall, some go through it."""

    def __init__(self, count: int, mapping: MappingConfig = MAPPING, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        generator = torch.Generator().manual_seed(seed)
        self.origins = rng.uniform(-0.3, 0.3, (count, 3)).astype(np.float32)
        directions = rng.normal(size=(count, 3))
        directions /= 1.5 * np.linalg.norm(directions, axis=1, keepdims=True)
        self.directions = directions.astype(np.float32)
        self.distances = rng.uniform(0.4, 4.0, count).astype(np.float32)
        self.colors = rng.uniform(size=(count, 3)).astype(np.float32)
        distances = torch.from_numpy(self.distances)
        self.along = sample_distances(distances, mapping, generator).numpy()
        self.weights = rng.uniform(0.2, 2.0, count).astype(np.float32)

    def arrays(self) -> tuple[NDArray, ...]:
        return self.origins, self.directions, self.distances, self.colors, self.along


def reference(
    network: FieldNetwork, rays: Rays, config: FieldConfig, weighted: bool
) -> tuple[NDArray, ...]:
    """Losses (R, 3), gradients of origins, directions and parameters."""
    inputs = [torch.tensor(array, dtype=torch.float64) for array in rays.arrays()]
    origins, directions, distances, colors, along = inputs
    origins.requires_grad_(True)
    directions.requires_grad_(True)
    points = origins[:, None] + along[..., None] * directions[:, None]
    values = network(points.reshape(-1, 3)).reshape(*along.shape, 4)
    rendering = render(values[..., 0], values[..., 1:], along, config, opaque_end=True)
    losses = ray_losses(values[..., 0], along, rendering, distances, colors, config, MAPPING)
    total = losses.total * torch.tensor(rays.weights) if weighted else losses.total
    parameters = list(network.parameters())
    gradients = torch.autograd.grad(total.mean(), [origins, directions, *parameters])
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients[2:]])
    stacked = torch.stack([losses.distance, losses.depth, losses.color], dim=1)
    return tuple(x.detach().numpy() for x in (stacked, gradients[0], gradients[1], flat))


def trained_field(config: FieldConfig, isa: str, threads: int = 1) -> kernel.KernelField:
    """A field with surfaces in it: without density there is nothing to render."""
    field = kernel.KernelField(config, seed=1, isa=isa, threads=threads)
    weights = field.flat()
    head = slice(-4 * config.width - 4, -4)
    weights[head] *= 10.0
    field.load_flat(weights)
    return field


def network_of(field: kernel.KernelField) -> FieldNetwork:
    network = FieldNetwork(field.config)
    network.load_flat(field.flat())
    return network.double()


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("isa", ISAS)
def test_training_on_rays_is_rendering_and_losses(isa: str, threads: int, weighted: bool) -> None:
    config = FieldConfig()
    field = trained_field(config, isa, threads)
    for count in (1, 250):
        rays = Rays(count)
        exact = reference(network_of(field), rays, config, weighted)
        losses, grad_origins, grad_directions = field.train_rays(
            *rays.arrays(), MAPPING, rays.weights if weighted else None
        )
        assert error(losses, exact[0]) < tolerance(isa) / 10
        if count > 1:
            assert error(grad_origins, exact[1]) < tolerance(isa)
            assert error(grad_directions, exact[2]) < tolerance(isa)
            assert error(field.fused.gradients(), exact[3]) < tolerance(isa)
        field.fused.zero_gradients()


@pytest.mark.parametrize("isa", ISAS)
def test_rays_with_more_samples_than_a_block(isa: str) -> None:
    config = FieldConfig()
    mapping = MappingConfig(free_samples=64, surface_samples=64)
    many = Rays(3, mapping, seed=4)
    along = np.concatenate([many.along, many.along + np.float32(0.01)], axis=1)
    many.along = np.sort(along, axis=1)
    field = trained_field(config, isa)
    exact = reference(network_of(field), many, config, weighted=False)
    losses, _, grad_directions = field.train_rays(*many.arrays(), MAPPING)
    assert error(losses, exact[0]) < tolerance(isa) / 10
    assert error(grad_directions, exact[2]) < 2 * tolerance(isa)
    assert error(field.fused.gradients(), exact[3]) < 2 * tolerance(isa)


def test_samples_are_distributed_as_the_reference_has_them() -> None:
    rng = np.random.default_rng(0)
    distances = rng.uniform(0.5, 4.0, 4000).astype(np.float32)
    generator = torch.Generator().manual_seed(0)
    expected = sample_distances(torch.from_numpy(distances), MAPPING, generator).numpy()
    actual = kernel.sample_rays(distances, MAPPING, seed=7)
    assert actual.shape == expected.shape
    assert (np.diff(actual, axis=1) >= 0).all()
    np.testing.assert_array_equal(actual, kernel.sample_rays(distances, MAPPING, seed=7))
    assert (actual != kernel.sample_rays(distances, MAPPING, seed=8)).mean() > 0.99
    # Quantiles of every sample, as shares of the ray and as offsets from the surface.
    for shown in (lambda x: x / distances[:, None], lambda x: x - distances[:, None]):
        levels = np.linspace(0.05, 0.95, 10)
        ours, theirs = (np.quantile(shown(x), levels, axis=0) for x in (actual, expected))
        np.testing.assert_allclose(ours, theirs, atol=0.05 * np.ptp(theirs, axis=0).max())
    near = np.abs(actual - distances[:, None])[:, MAPPING.free_samples :]
    assert near.mean() == pytest.approx(0.8 * MAPPING.surface_sigma_m, rel=0.1)


@pytest.mark.parametrize("threads", [1, 2])
def test_posed_rays_are_rays_with_poses(threads: int) -> None:
    """Against `train_rays` in region coordinates, the twists through torch."""
    field = trained_field(FieldConfig(), "portable", threads)
    rng = np.random.default_rng(5)
    count, poses = 120, 4
    rays = Rays(count)
    directions = rays.directions / np.linalg.norm(rays.directions, axis=1, keepdims=True)
    rotations = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(poses)])
    translations = rng.normal(size=(poses, 3)) * 0.3
    pose = rng.integers(poses, size=count)
    affine = np.concatenate(
        [np.linalg.qr(rng.normal(size=(3, 3)))[0] / 1.5, [[0.1], [0.2], [0]]], 1
    )
    losses, grad_twists = field.train_posed_rays(
        rotations.astype(np.float32),
        translations.astype(np.float32),
        pose,
        directions,
        rays.distances,
        rays.colors,
        affine.astype(np.float32),
        MAPPING,
        3,
        rays.weights,
    )
    gradients = field.fused.gradients()
    field.fused.zero_gradients()

    twists = torch.zeros(poses, 6, dtype=torch.float64, requires_grad=True)
    linear = torch.tensor(affine[:, :3])
    in_map = torch.tensor(np.einsum("rij,rj->ri", rotations[pose], directions))
    in_map = in_map + torch.linalg.cross(twists[pose, 3:], in_map)
    origins = torch.tensor(translations)[pose] + twists[pose, :3]
    placed = origins @ linear.T + torch.tensor(affine[:, 3]), in_map @ linear.T
    expected, grad_origins, grad_directions = field.train_rays(
        *(x.detach().float().numpy() for x in placed),
        rays.distances,
        rays.colors,
        kernel.sample_rays(rays.distances, MAPPING, seed=3),
        MAPPING,
        rays.weights,
    )
    torch.autograd.backward(placed, [torch.tensor(g) for g in (grad_origins, grad_directions)])
    np.testing.assert_allclose(losses, expected, rtol=1e-3, atol=1e-4)
    assert error(grad_twists, twists.grad.numpy()) < 1e-3
    assert error(gradients, field.fused.gradients()) < 1e-3


def test_poses_are_checked() -> None:
    field = trained_field(FieldConfig(), "auto")
    rays = Rays(5)
    rotations, translations = np.zeros((2, 3, 3), np.float32), np.zeros((2, 3), np.float32)
    rest = (rays.directions, rays.distances, rays.colors, np.eye(3, 4, dtype=np.float32))
    with pytest.raises(IndexError, match=r"pose\[4\] is 2, but there are 2 poses"):
        field.train_posed_rays(
            rotations, translations, np.array([0, 1, 0, 1, 2]), *rest, MAPPING, seed=0
        )
    with pytest.raises(ValueError, match="int64"):
        field.train_posed_rays(
            rotations, translations, np.zeros(5, np.int32), *rest, MAPPING, seed=0
        )


def test_no_rays() -> None:
    field = trained_field(FieldConfig(), "auto")
    losses, grad_origins, _ = field.train_rays(*Rays(0).arrays(), MAPPING)
    assert losses.shape == (0, 3)
    assert grad_origins.shape == (0, 3)


@pytest.mark.parametrize("isa", ISAS)
def test_training_on_rays_finds_a_wall(isa: str) -> None:
    field = kernel.KernelField(FieldConfig(), seed=0, isa=isa)
    generator = torch.Generator().manual_seed(0)
    rng = np.random.default_rng(0)

    def batch() -> tuple[NDArray, ...]:
        rays = Rays(128, seed=int(rng.integers(1 << 30)))
        rays.origins[:] = 0.0
        rays.directions[:, 0] = 0.5
        rays.directions[:, 1:] *= 0.2
        lengths = np.linalg.norm(rays.directions, axis=1)
        rays.directions /= 1.5 * lengths[:, None]
        # A wall at x = 0.8 in region coordinates.
        rays.distances = 0.8 / rays.directions[:, 0]
        rays.along = sample_distances(torch.from_numpy(rays.distances), MAPPING, generator).numpy()
        rays.colors[:] = (0.9, 0.5, 0.1)
        return rays.arrays()

    first = field.train_rays(*batch(), MAPPING)[0].mean()
    for _ in range(120):
        field.train_rays(*batch(), MAPPING)
        assert field.step(4e-3)
    assert field.train_rays(*batch(), MAPPING)[0].mean() < 0.2 * first
    before, behind = field.predict(np.float32([[0.6, 0, 0], [0.85, 0, 0]]))
    assert before[0] < -0.5
    assert behind[0] > 0.3
    np.testing.assert_allclose(behind[1:], (0.9, 0.5, 0.1), atol=0.15)


def test_arrays_of_rays_are_checked() -> None:
    field = trained_field(FieldConfig(), "auto")
    rays = Rays(5)
    with pytest.raises(ValueError, match=r"directions has shape \(4, 3\); \(5, 3\) is expected"):
        field.train_rays(
            rays.origins, rays.directions[:4], rays.distances, rays.colors, rays.along, MAPPING
        )
    with pytest.raises(ValueError, match="along has shape"):
        field.train_rays(
            rays.origins, rays.directions, rays.distances, rays.colors, rays.distances, MAPPING
        )


@pytest.mark.parametrize("color_weight", [0.0, 0.15])
@pytest.mark.parametrize("isa", ISAS)
def test_normal_equations(isa: str, color_weight: float) -> None:
    config = FieldConfig()
    field = trained_field(config, isa, threads=2)
    rng = np.random.default_rng(3)
    count = 400
    points = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    arms = rng.normal(size=(count, 3)).astype(np.float32)
    luma = rng.uniform(size=count).astype(np.float32)
    weights = rng.uniform(0.0, 1.5, count).astype(np.float32)
    weights[::7] = 0.0
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    equations = AlignmentSettings(
        to_map=rotation / 1.5,
        surface_level=surface_level(config),
        saturation=0.95,
        min_slope=1.0,
        huber_m=0.05,
        color_weight=color_weight,
    )
    information, gradient, distance, usable = astuple(
        field.normal_equations(points, arms, luma, weights, equations)
    )

    # The kernel's own values and slopes, which other tests hold to torch's.
    values, slopes, luma_slopes = (x.astype(np.float64) for x in field.probe(points))
    slopes, luma_slopes = slopes @ equations.to_map, luma_slopes @ equations.to_map
    length = np.linalg.norm(slopes, axis=1)
    expected_usable = (weights > 0) & (np.abs(values[:, 0]) < 0.95) & (length > 1.0)
    np.testing.assert_array_equal(usable, expected_usable)
    assert 20 < np.count_nonzero(usable) < 0.9 * count
    expected_distance = (values[:, 0] - equations.surface_level) / length
    np.testing.assert_allclose(distance, expected_distance, rtol=1e-4, atol=1e-6)

    def jacobian(direction: NDArray) -> NDArray:
        return np.concatenate([direction, np.cross(arms, direction)], axis=1)

    def huber(residual: NDArray) -> NDArray:
        return np.minimum(1.0, 0.05 / np.maximum(np.abs(residual), 1e-12))

    J = jacobian(slopes / length[:, None])
    weight = weights * usable * huber(expected_distance)
    expected_information = (J * weight[:, None]).T @ J
    expected_gradient = J.T @ (weight * expected_distance)
    residual = values[:, 1:] @ (0.299, 0.587, 0.114) - luma
    weight = weights * usable * huber(color_weight * residual) * color_weight**2
    J = jacobian(luma_slopes)
    expected_information += (J * weight[:, None]).T @ J
    expected_gradient += J.T @ (weight * residual)
    assert error(information, expected_information) < 1e-5
    assert error(gradient, expected_gradient) < 1e-5
