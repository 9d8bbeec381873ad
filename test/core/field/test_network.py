"""A region's network: layout of the weights, gradients, and the exact shift of its origin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from meslam_core.config import FieldConfig
from meslam_core.field.model import LUMA, TorchField
from meslam_core.field.network import (
    FieldNetwork,
    parameter_count,
    parameter_shapes,
    shifted,
)

CONFIG = FieldConfig(width=32, embedding=24, backend="torch")


def points(count: int, seed: int = 0, extent: float = 1.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=generator) * 2 - 1) * extent


def test_outputs_are_a_distance_and_a_colour():
    values = FieldNetwork(CONFIG)(points(500, extent=2.2))
    assert values.shape == (500, 4)
    assert ((values[:, 1:] >= 0) & (values[:, 1:] <= 1)).all()


def test_the_flat_layout_is_the_documented_one():
    network = FieldNetwork(CONFIG, seed=1)
    named = {name: tuple(p.shape) for name, p in network.named_parameters()}
    assert list(named.items()) == list(parameter_shapes(32, 24).items())
    vector = network.flat()
    assert vector.dtype == np.float32
    assert vector.shape == (parameter_count(32, 24),)
    np.testing.assert_array_equal(
        vector[: 3 * 24].reshape(24, 3), network.encoding.frequencies.detach().numpy()
    )


def test_weights_survive_the_flat_vector():
    source, target = FieldNetwork(CONFIG, seed=1), FieldNetwork(CONFIG, seed=2)
    inputs = points(50)
    assert not torch.allclose(source(inputs), target(inputs))
    target.load_flat(source.flat())
    torch.testing.assert_close(source(inputs), target(inputs), atol=0, rtol=0)


def test_the_seed_decides_the_weights():
    first, again = FieldNetwork(CONFIG, seed=5).flat(), FieldNetwork(CONFIG, seed=5).flat()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, FieldNetwork(CONFIG, seed=6).flat())


@given(st.tuples(*[st.floats(-1.6, 1.6)] * 3))
def test_a_shifted_field_says_the_same_about_the_same_place(offset):
    network, moved = FieldNetwork(CONFIG, seed=3), FieldNetwork(CONFIG)
    moved.load_flat(shifted(network.flat(), CONFIG.embedding, np.array(offset)))
    inputs = points(200, extent=1.5)
    torch.testing.assert_close(
        moved(inputs), network(inputs + torch.tensor(offset)), atol=2e-4, rtol=0
    )


def test_shifting_there_and_back_changes_nothing():
    vector, offset = FieldNetwork(CONFIG).flat(), np.array([1.6, -0.4, 0.0])
    back = shifted(shifted(vector, CONFIG.embedding, offset), CONFIG.embedding, -offset)
    turns = (back - vector) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
    assert np.abs(back[3 * 24 : 4 * 24]).max() <= np.pi + 1e-6


def test_gradients_agree_with_finite_differences():
    network = FieldNetwork(CONFIG).double()
    inputs = points(6).double().requires_grad_(True)
    assert torch.autograd.gradcheck(network, (inputs,), eps=1e-7, atol=1e-5)
    loss = network(inputs).square().sum()
    loss.backward()
    generator = np.random.default_rng(0)
    for name, parameter in network.named_parameters():
        entry = tuple(int(generator.integers(n)) for n in parameter.shape)
        values = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                parameter[entry] += step
                values.append(float(network(inputs).square().sum()))
                parameter[entry] -= step
        numeric = (values[0] - values[1]) / 2e-6
        assert parameter.grad[entry].item() == pytest.approx(numeric, abs=1e-4, rel=1e-4), name


def test_predictions_and_evaluations_agree():
    field = TorchField(CONFIG, seed=2)
    inputs = points(100)
    np.testing.assert_array_equal(
        field.predict(inputs.numpy()), field.evaluate(inputs).detach().numpy()
    )


def test_probe_answers_with_derivatives_by_the_point():
    field = TorchField(CONFIG, seed=2)
    inputs = points(40).numpy()
    values, distance_gradient, luma_gradient = field.probe(inputs)
    np.testing.assert_allclose(values, field.predict(inputs), atol=1e-6)
    step = 1e-3
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        change = (field.predict(inputs + shift) - field.predict(inputs - shift)) / (2 * step)
        # A rectifier may switch between the two points.
        off_f = np.abs(change[:, 0] - distance_gradient[:, axis])
        off_luma = np.abs(change[:, 1:] @ LUMA - luma_gradient[:, axis])
        assert np.median(off_f) < 0.02 * np.abs(distance_gradient).max()
        assert np.median(off_luma) < 0.02 * np.abs(luma_gradient).max()


def test_a_step_goes_downhill():
    field = TorchField(CONFIG, seed=2)
    inputs = points(200)

    def loss() -> torch.Tensor:
        return (field.evaluate(inputs)[:, 0] - 0.7).abs().mean()

    before = loss().item()
    for _ in range(30):
        loss().backward()
        assert field.step(1e-3)
    assert loss().item() < 0.5 * before


def test_a_gradient_that_is_not_finite_is_not_taken():
    field = TorchField(CONFIG, seed=2)
    before = field.flat()
    (field.evaluate(points(10)).sum() * float("nan")).backward()
    assert not field.step(1e-3)
    np.testing.assert_array_equal(field.flat(), before)
    field.evaluate(points(10)).sum().backward()
    assert field.step(1e-3)
    assert np.isfinite(field.flat()).all()
