"""The compiled kernel against the definition of the network in float64 torch."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.errors import ConfigError
from meslam_core.field import kernel
from meslam_core.field.model import AVERAGE_SHARE, LUMA, FieldModel, TorchField
from meslam_core.field.network import parameter_shapes

ISAS = kernel.available_isas()
if not ISAS:
    pytest.skip(kernel.unavailable_reason(), allow_module_level=True)

EMBEDDING = 96
SINGLE_PRECISION = {"avx512", "avx2", "portable"}
# Root mean square error over the root mean square of the exact numbers. With bfloat16's 8 bits a
# ReLU near its kink switches, so gradients differ by several percent whoever computes them.
VALUE_TOLERANCE = {isa: 1e-4 if isa in SINGLE_PRECISION else 0.01 for isa in ISAS}
GRADIENT_TOLERANCE = {isa: 1e-4 if isa in SINGLE_PRECISION else 0.15 for isa in ISAS}

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def random_parameters(width: int, embedding: int = EMBEDDING, seed: int = 0) -> Floats:
    """Weights as a region has them in use: scaled by their inputs, with biases that matter."""
    rng = np.random.default_rng(seed)
    parts = []
    for name, shape in parameter_shapes(width, embedding).items():
        if name == "encoding.frequencies":
            part = rng.normal(0.0, 9.0, shape)
        elif name == "encoding.phases":
            part = rng.uniform(-np.pi, np.pi, shape)
        elif name.endswith("weight"):
            part = rng.uniform(-1.0, 1.0, shape) * (6.0 / shape[1]) ** 0.5
        else:
            part = rng.normal(0.0, 0.1, shape)
        parts.append(part.ravel())
    return np.concatenate(parts).astype(np.float32)


class Reference:
    """The network as it is defined, in float64."""

    def __init__(self, parameters: Floats, width: int, embedding: int = EMBEDDING) -> None:
        self.flat = torch.tensor(parameters, dtype=torch.float64, requires_grad=True)
        shapes = parameter_shapes(width, embedding).values()
        sizes = [int(np.prod(shape)) for shape in shapes]
        self.parts = [
            part.view(shape) for part, shape in zip(self.flat.split(sizes), shapes, strict=True)
        ]

    def layers(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Values (N, 4) and the sums before every ReLU (N, 4 W)."""
        B, phi, w1, b1, w2, b2, w3, b3, w4, b4, w5, b5 = self.parts
        embedded = torch.sin(points @ B.T + phi)
        z1 = embedded @ w1.T + b1
        z2 = torch.relu(z1) @ w2.T + b2
        z3 = torch.cat([torch.relu(z2), embedded], dim=1) @ w3.T + b3
        z4 = torch.relu(z3) @ w4.T + b4
        output = torch.relu(z4) @ w5.T + b5
        values = torch.cat([output[:, :1], torch.sigmoid(output[:, 1:])], dim=1)
        return values, torch.cat([z1, z2, z3, z4], dim=1)

    def values(self, points: Floats) -> Doubles:
        return self.layers(torch.tensor(points, dtype=torch.float64))[0].detach().numpy()

    def rounded(self, points: Floats, grad_values: Floats) -> tuple[Doubles, Doubles, Doubles]:
        """Values and gradients as torch computes them with bfloat16 products."""
        flat = self.flat.detach().float().requires_grad_(True)
        sizes = [part.numel() for part in self.parts]
        shapes = [part.shape for part in self.parts]
        B, phi, *layers = [
            part.view(shape) for part, shape in zip(flat.split(sizes), shapes, strict=True)
        ]
        inputs = torch.tensor(points, requires_grad=True)
        embedded = torch.sin(inputs @ B.T + phi)
        hidden = embedded
        with torch.autocast("cpu", torch.bfloat16):
            for layer in range(4):
                if layer == 2:
                    hidden = torch.cat([hidden, embedded], dim=1)
                hidden = torch.relu(torch.nn.functional.linear(hidden, *layers[2 * layer :][:2]))
            output = torch.nn.functional.linear(hidden, *layers[8:]).float()
        values = torch.cat([output[:, :1], torch.sigmoid(output[:, 1:])], dim=1)
        seeds = torch.tensor(grad_values)
        gradients = torch.autograd.grad((values * seeds).sum(), [flat, inputs])
        return values.detach().numpy(), gradients[0].numpy(), gradients[1].numpy()

    def gradients(self, points: Floats, grad_values: Floats) -> tuple[Doubles, Doubles]:
        """Gradients with respect to the parameters and the points."""
        inputs = torch.tensor(points, dtype=torch.float64, requires_grad=True)
        values, _ = self.layers(inputs)
        seeds = torch.tensor(grad_values, dtype=torch.float64)
        flat, points_gradient = torch.autograd.grad((values * seeds).sum(), [self.flat, inputs])
        return flat.numpy(), points_gradient.numpy()

    def smooth(self, points: Floats, margin: float) -> Floats:
        """The points at which no ReLU is within `margin` of its kink, where gradients jump."""
        _, sums = self.layers(torch.tensor(points, dtype=torch.float64))
        return points[(sums.abs().amin(dim=1) > margin).numpy()]


def random_points(count: int, seed: int = 1) -> Floats:
    rng = np.random.default_rng(seed)
    return rng.uniform(-3.0, 3.0, (count, 3)).astype(np.float32)


def smooth_points(reference: Reference, count: int, isa: str) -> Floats:
    """Points whose gradient is defined in the precision of an instruction set.

    For bfloat16 any: its rounding crosses kinks everywhere, and the tolerance covers that.
    """
    if isa not in SINGLE_PRECISION:
        return random_points(count)
    points = reference.smooth(random_points(2 * count + 20), margin=2e-5)
    assert len(points) >= count
    return np.ascontiguousarray(points[:count])


def seeds_for(points: Floats, seed: int = 2) -> Floats:
    return np.random.default_rng(seed).normal(size=(len(points), 4)).astype(np.float32)


def error(actual: NDArray, expected: NDArray) -> float:
    """Root mean square error relative to the root mean square of what is expected."""
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


def fused_field(isa: str, parameters: Floats, width: int, threads: int = 1, embedding: int = 96):
    from meslam_core.field._kernel import FusedField

    field = FusedField(width, embedding, isa, threads)
    field.set_parameters(parameters)
    return field


def by_parameter(flat: NDArray, width: int) -> list[NDArray]:
    """A flat vector cut into B, phi, W1, b1, ..."""
    sizes = [int(np.prod(shape)) for shape in parameter_shapes(width, EMBEDDING).values()]
    return np.split(flat, np.cumsum(sizes)[:-1])


@pytest.mark.parametrize("width", kernel.WIDTHS)
@pytest.mark.parametrize("isa", [isa for isa in ISAS if isa in SINGLE_PRECISION])
def test_single_precision_agrees_with_float64(isa: str, width: int) -> None:
    for seed in range(2):
        parameters = random_parameters(width, seed=seed)
        reference = Reference(parameters, width)
        points = smooth_points(reference, 200, isa)
        seeds = seeds_for(points)
        field = fused_field(isa, parameters, width)
        values = field.forward(points)
        points_gradient = field.backward(points, seeds)
        exact_parameters, exact_points = reference.gradients(points, seeds)
        assert error(values, reference.values(points)) < 1e-4
        assert error(points_gradient, exact_points) < 1e-4
        pairs = zip(
            by_parameter(field.gradients(), width),
            by_parameter(exact_parameters, width),
            strict=True,
        )
        for actual, exact in pairs:
            assert error(actual, exact) < 1e-4


@pytest.mark.parametrize("width", kernel.WIDTHS)
@pytest.mark.parametrize("isa", [isa for isa in ISAS if isa not in SINGLE_PRECISION])
def test_bfloat16_is_as_close_to_float64_as_torchs(isa: str, width: int) -> None:
    for seed in range(2):
        parameters = random_parameters(width, seed=seed)
        reference = Reference(parameters, width)
        points = random_points(500)
        seeds = seeds_for(points)
        exact_parameters, exact_points = reference.gradients(points, seeds)
        values, parameters_gradient, points_gradient = reference.rounded(points, seeds)
        field = fused_field(isa, parameters, width)

        def close(actual: NDArray, of_torch: NDArray, exact: NDArray) -> bool:
            return error(actual, exact) < 1.4 * error(of_torch, exact) + 1e-6

        assert close(field.forward(points), values, reference.values(points))
        assert close(field.backward(points, seeds), points_gradient, exact_points)
        triples = zip(
            by_parameter(field.gradients(), width),
            by_parameter(parameters_gradient, width),
            by_parameter(exact_parameters, width),
            strict=True,
        )
        for actual, of_torch, exact in triples:
            assert close(actual, of_torch, exact)


@pytest.mark.parametrize("isa", ISAS)
def test_spatial_gradients_of_distance_and_luma(isa: str) -> None:
    parameters = random_parameters(64)
    reference = Reference(parameters, 64)
    points = smooth_points(reference, 300, isa)
    field = fused_field(isa, parameters, 64)
    values, distance, luma = field.forward_with_gradient(points)
    distance_seed = np.tile(np.float32([1, 0, 0, 0]), (len(points), 1))
    luma_seed = np.tile(np.float32([0, *LUMA]), (len(points), 1))
    np.testing.assert_array_equal(values, field.forward(points))
    assert error(distance, reference.gradients(points, distance_seed)[1]) < GRADIENT_TOLERANCE[isa]
    assert error(luma, reference.gradients(points, luma_seed)[1]) < GRADIENT_TOLERANCE[isa]
    without = field.forward_with_gradient(points, luma=False)
    np.testing.assert_array_equal(without[1], distance)
    assert without[2] is None
    assert not field.gradients().any()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("isa", ISAS)
def test_any_number_of_points(isa: str, threads: int) -> None:
    parameters = random_parameters(64)
    reference = Reference(parameters, 64)
    for count in (1, 63, 65, 1000):
        points = smooth_points(reference, count, isa)
        seeds = seeds_for(points)
        field = fused_field(isa, parameters, 64, threads)
        exact_parameters, exact_points = reference.gradients(points, seeds)
        assert error(field.forward(points), reference.values(points)) < VALUE_TOLERANCE[isa]
        assert error(field.backward(points, seeds), exact_points) < GRADIENT_TOLERANCE[isa]
        assert error(field.gradients(), exact_parameters) < GRADIENT_TOLERANCE[isa]


@pytest.mark.parametrize("isa", ISAS)
def test_no_points(isa: str) -> None:
    field = fused_field(isa, random_parameters(64), 64, threads=2)
    nothing = np.zeros((0, 3), np.float32)
    assert field.forward(nothing).shape == (0, 4)
    assert field.forward_with_gradient(nothing)[1].shape == (0, 3)
    assert field.backward(nothing, np.zeros((0, 4), np.float32)).shape == (0, 3)
    assert not field.gradients().any()


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("embedding", [32, 160])
def test_other_embeddings(isa: str, embedding: int) -> None:
    parameters = random_parameters(128, embedding)
    reference = Reference(parameters, 128, embedding)
    points = smooth_points(reference, 100, isa)
    seeds = seeds_for(points)
    field = fused_field(isa, parameters, 128, embedding=embedding)
    exact_parameters, exact_points = reference.gradients(points, seeds)
    assert error(field.forward(points), reference.values(points)) < VALUE_TOLERANCE[isa]
    assert error(field.backward(points, seeds), exact_points) < GRADIENT_TOLERANCE[isa]
    assert error(field.gradients(), exact_parameters) < GRADIENT_TOLERANCE[isa]


@pytest.mark.parametrize("isa", ISAS)
def test_results_do_not_depend_on_timing(isa: str) -> None:
    points = random_points(2000)
    seeds = seeds_for(points)
    results = []
    for _ in range(4):
        field = fused_field(isa, random_parameters(64), 64, threads=2)
        points_gradient = field.backward(points, seeds)
        results.append((points_gradient.tobytes(), field.gradients().tobytes()))
    assert len(set(results)) == 1


@pytest.mark.parametrize("isa", ISAS)
def test_gradients_accumulate_until_cleared(isa: str) -> None:
    points = random_points(130)
    seeds = seeds_for(points)
    field = fused_field(isa, random_parameters(64), 64)
    field.backward(points, seeds, want_points=False)
    once = field.gradients()
    field.backward(points, seeds, want_points=False)
    np.testing.assert_allclose(field.gradients(), 2 * once, rtol=1e-5, atol=1e-4)
    field.zero_gradients()
    assert not field.gradients().any()


@pytest.mark.parametrize("isa", ISAS)
def test_adam_is_torchs(isa: str) -> None:
    parameters = random_parameters(64)
    field = fused_field(isa, parameters, 64)
    tensor = torch.tensor(parameters, requires_grad=True)
    optimizer = torch.optim.Adam([tensor], lr=4e-3, betas=(0.9, 0.99), eps=1e-8)
    points = random_points(100)
    for step in range(5):
        field.backward(points, seeds_for(points, seed=step))
        tensor.grad = torch.from_numpy(field.gradients())
        assert field.adam_step(4e-3)
        optimizer.step()
        assert not field.gradients().any()
    np.testing.assert_allclose(field.parameters(), tensor.detach().numpy(), rtol=1e-5, atol=1e-6)


def test_optimizer_state_continues_and_resets() -> None:
    points = random_points(100)
    seeds = seeds_for(points)
    field = fused_field("auto", random_parameters(64), 64)
    field.backward(points, seeds)
    field.adam_step(4e-3)
    twin = fused_field("auto", field.parameters(), 64)
    twin.set_optimizer_state(*field.optimizer_state())
    for other in (field, twin):
        other.backward(points, seeds)
        other.adam_step(4e-3)
    np.testing.assert_array_equal(field.parameters(), twin.parameters())
    field.reset_optimizer()
    first, second, step = field.optimizer_state()
    assert not first.any()
    assert not second.any()
    assert step == 0


def test_encoding_can_learn_at_its_own_rate() -> None:
    parameters = random_parameters(64)
    field = fused_field("auto", parameters, 64)
    points = random_points(100)
    field.backward(points, seeds_for(points))
    field.adam_step(4e-3, encoding_scale=0.0)
    changed = field.parameters() != parameters
    assert not changed[: 4 * EMBEDDING].any()
    assert changed[4 * EMBEDDING :].mean() > 0.9


@pytest.mark.parametrize("isa", ISAS)
def test_a_step_with_bad_gradients_is_skipped(isa: str) -> None:
    parameters = random_parameters(64)
    field = fused_field(isa, parameters, 64)
    points = random_points(100)
    seeds = seeds_for(points)
    seeds[50, 0] = np.nan
    field.backward(points, seeds)
    assert not field.adam_step(4e-3)
    np.testing.assert_array_equal(field.parameters(), parameters)
    assert field.optimizer_state()[2] == 0
    field.backward(points, seeds_for(points))
    assert field.adam_step(4e-3)


@pytest.mark.parametrize("isa", ISAS)
def test_points_that_are_not_finite_show(isa: str) -> None:
    points = random_points(10)
    points[3, 1] = np.nan
    points[6, 0] = np.inf
    values = fused_field(isa, random_parameters(64), 64).forward(points)
    bad = ~np.isfinite(values).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(bad), [3, 6])


def test_colours_saturate_without_overflow() -> None:
    parameters = random_parameters(64)
    parameters[-3:] = [1e4, -1e4, 100.0]
    for isa in ISAS:
        values = fused_field(isa, parameters, 64).forward(random_points(10))
        np.testing.assert_allclose(values[:, 1:], [[1.0, 0.0, 1.0]] * 10, atol=1e-8)


def final_loss(field: kernel.KernelField | TorchField, seed: int) -> float:
    """Of fitting a sphere with a colour gradient."""
    generator = torch.Generator().manual_seed(seed)
    losses = []
    for step in range(150):
        points = torch.rand(512, 3, generator=generator) * 2 - 1
        distance = (points.norm(dim=1) - 0.6).mul(5).clamp(-1, 1)
        target = torch.cat([distance[:, None], points * 0.5 + 0.5], dim=1)
        loss = (field.evaluate(points) - target).abs().mean()
        loss.backward()
        assert field.step(4e-3)
        if step >= 120:
            losses.append(float(loss.detach()))
    return float(np.mean(losses))


SEEDS = range(3)


@pytest.fixture(scope="module")
def loss_of_torch() -> float:
    return float(np.mean([final_loss(TorchField(FieldConfig(), seed), seed) for seed in SEEDS]))


@pytest.mark.parametrize("isa", ISAS)
def test_training_reaches_the_loss_of_torch(isa: str, loss_of_torch: float) -> None:
    losses = [final_loss(kernel.KernelField(FieldConfig(), seed, isa), seed) for seed in SEEDS]
    assert loss_of_torch < 0.1
    assert np.mean(losses) == pytest.approx(loss_of_torch, rel=0.05)


def test_field_gives_torch_the_gradient_of_points() -> None:
    config = FieldConfig(width=64)
    reference = TorchField(config, seed=3)
    field = kernel.KernelField(config, seed=3, isa="portable", threads=2)
    np.testing.assert_array_equal(field.flat(), reference.flat())
    gradients = []
    for model in (reference, field):
        points = torch.from_numpy(random_points(40)).requires_grad_(True)
        (model.evaluate(points) ** 2).sum().backward()
        gradients.append(points.grad)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-3)


def test_loading_weights_forgets_the_optimiser() -> None:
    field = kernel.KernelField(FieldConfig(width=64))
    points = random_points(50)
    field.fused.backward(points, seeds_for(points))
    field.step(1e-3)
    weights = random_parameters(64, seed=5)
    field.load_flat(weights)
    np.testing.assert_array_equal(field.flat(), weights)
    assert field.fused.optimizer_state()[2] == 0


@pytest.mark.parametrize("make", [TorchField, kernel.KernelField])
def test_the_average_follows_the_weights_and_begins_anew_with_others(
    make: Callable[[FieldConfig], FieldModel],
) -> None:
    field = make(FieldConfig(width=64))
    expected = field.average()
    np.testing.assert_array_equal(expected, field.flat())
    for _ in range(3):
        (field.evaluate(torch.from_numpy(random_points(50))) ** 2).sum().backward()
        assert field.step(1e-2)
        expected += AVERAGE_SHARE * (field.flat() - expected)
    assert np.abs(field.flat() - expected).max() > 1e-3
    np.testing.assert_allclose(field.average(), expected, atol=1e-5)
    weights = random_parameters(64, seed=5)
    field.load_flat(weights)
    np.testing.assert_array_equal(field.average(), weights)


def test_cap_on_the_instruction_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MESLAM_KERNEL_ISA", "portable")
    assert kernel.available_isas() == ("portable",)
    assert kernel.KernelField(FieldConfig(width=64)).fused.isa == "portable"
    with pytest.raises(ConfigError, match="avx2"):
        kernel.KernelField(FieldConfig(width=64), isa="avx2")
    monkeypatch.setenv("MESLAM_KERNEL_ISA", "mmx")
    with pytest.raises(ConfigError, match="MESLAM_KERNEL_ISA"):
        kernel.available_isas()


@pytest.mark.parametrize("config", [FieldConfig(width=96), FieldConfig(embedding=100)])
def test_sizes_without_code_are_refused(config: FieldConfig) -> None:
    assert kernel.unavailable_reason(config)
    with pytest.raises(ConfigError, match="torch"):
        kernel.KernelField(config)


def test_arrays_are_checked() -> None:
    field = fused_field("auto", random_parameters(64), 64)
    points = random_points(10)
    with pytest.raises(TypeError, match=r"points has dtype float64; float32 is expected"):
        field.forward(points.astype(np.float64))
    with pytest.raises(ValueError, match=r"points has shape \(10, 2\); \(N, 3\) is expected"):
        field.forward(np.ascontiguousarray(points[:, :2]))
    with pytest.raises(ValueError, match="contiguous"):
        field.forward(points[::2])
    with pytest.raises(ValueError, match=r"grad_values has shape \(9, 4\); \(10, 4\)"):
        field.backward(points, np.zeros((9, 4), np.float32))
    with pytest.raises(ValueError, match="parameters has shape"):
        field.set_parameters(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="not finite"):
        field.set_parameters(np.full(field.parameter_count, np.nan, np.float32))
    with pytest.raises(ValueError, match="threads is 0"):
        type(field)(64, 96, "auto", 0)


def test_calls_from_several_threads_follow_one_another() -> None:
    """Tracking reads the field that mapping trains."""
    parameters = random_parameters(64)
    field = fused_field("auto", parameters, 64, threads=2)
    points = random_points(3000)
    seeds = seeds_for(points)
    expected = field.forward(points)
    field.backward(points, seeds)
    gradients = field.gradients()
    field.zero_gradients()
    with ThreadPoolExecutor(3) as pool:
        reads = [pool.submit(field.forward, points) for _ in range(20)]
        writes = [pool.submit(field.backward, points, seeds) for _ in range(8)]
        for read in reads:
            np.testing.assert_array_equal(read.result(), expected)
        for write in writes:
            write.result()
    np.testing.assert_allclose(field.gradients(), 8 * gradients, rtol=1e-4, atol=1e-3)


def test_weights_that_stopped_learning_do_not_slow_the_optimiser() -> None:
    """Their moments would decay to denormal numbers, which are a hundred times slower."""
    field = fused_field("auto", random_parameters(64), 64)
    tiny = np.full(field.parameter_count, 2e-38, np.float32)
    field.set_optimizer_state(tiny, tiny, 5)
    for _ in range(100):
        field.adam_step(1e-3)
    first, second, _ = field.optimizer_state()
    assert not first.any()
    assert not second.any()
