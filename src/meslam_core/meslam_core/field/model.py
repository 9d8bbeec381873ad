"""A trainable field behind one interface, computed by torch or by the compiled kernel."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.field.network import FieldNetwork

ADAM_BETAS = (0.9, 0.99)
ADAM_EPSILON = 1e-8
# Share of the running average that each step's weights take: it follows them by some 50 steps,
# and evens out Adam's noise, which moves the whole surface by millimetres from step to step.
AVERAGE_SHARE = 0.02
LUMA = (0.299, 0.587, 0.114)

Floats = NDArray[np.float32]


class FieldModel(Protocol):
    """What mapping, tracking and the map ask of a region's network.

    Points are region coordinates, float32 (N, 3). Values are (N, 4): the truncated signed
    distance f and the colour in [0, 1].
    """

    config: FieldConfig
    device: torch.device

    def evaluate(self, points: torch.Tensor) -> torch.Tensor:
        """Values with gradients: backward reaches the points and the weights."""
        ...

    def step(self, learning_rate: float) -> bool:
        """One Adam step with the gradients since the last; False (and no step) if not finite."""
        ...

    def predict(self, points: Floats) -> Floats:
        """Values without gradients."""
        ...

    def probe(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Values (N, 4), df/dpoint (N, 3) and dluma/dpoint (N, 3), for tracking."""
        ...

    def flat(self) -> Floats:
        """Copy of the weights in the layout of `network.parameter_shapes`."""
        ...

    def average(self) -> Floats:
        """Copy of the weights averaged over the last steps, in the layout of `flat`."""
        ...

    def load_flat(self, vector: Floats) -> None:
        """Replace the weights and their average, and forget the optimiser's state."""
        ...

    def optimizer_state(self) -> tuple[Floats, Floats, int]:
        """Adam's first and second moments in the layout of `flat`, and its number of steps."""
        ...

    def load_optimizer_state(self, first: Floats, second: Floats, step: int) -> None:
        """Go on where an optimiser was that had this state."""
        ...


class TorchField:
    """`FieldModel` on torch: the reference on the CPU, and the fast path on a GPU."""

    def __init__(
        self, config: FieldConfig, seed: int = 0, device: torch.device | None = None
    ) -> None:
        self.config = config
        self.device = device or torch.device("cpu")
        self.network = FieldNetwork(config, seed).to(self.device)
        self._optimizer = self._new_optimizer()
        self._average = self._vector()

    def _vector(self) -> torch.Tensor:
        return torch.nn.utils.parameters_to_vector(self.network.parameters()).detach()

    def _new_optimizer(self) -> torch.optim.Adam:
        return torch.optim.Adam(
            self.network.parameters(), lr=1e-3, betas=ADAM_BETAS, eps=ADAM_EPSILON, foreach=True
        )

    def evaluate(self, points: torch.Tensor) -> torch.Tensor:
        values: torch.Tensor = self.network(points)
        return values

    def step(self, learning_rate: float) -> bool:
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        finite = bool(torch.isfinite(torch.stack(torch._foreach_norm(gradients))).all())
        if finite:
            self._optimizer.param_groups[0]["lr"] = learning_rate
            self._optimizer.step()
            self._average.lerp_(self._vector(), AVERAGE_SHARE)
        self._optimizer.zero_grad(set_to_none=True)
        return finite

    def predict(self, points: Floats) -> Floats:
        batches = torch.split(torch.from_numpy(points), 1 << 16)
        with torch.no_grad():
            return np.concatenate(
                [self.network(batch.to(self.device)).cpu().numpy() for batch in batches]
            )

    def probe(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        inputs = torch.from_numpy(points).to(self.device).requires_grad_(True)
        values = self.network(inputs)
        luma = values[:, 1:] @ values.new_tensor(LUMA)
        (distance_gradient,) = torch.autograd.grad(values[:, 0].sum(), inputs, retain_graph=True)
        (luma_gradient,) = torch.autograd.grad(luma.sum(), inputs)
        return (
            values.detach().cpu().numpy(),
            distance_gradient.cpu().numpy(),
            luma_gradient.cpu().numpy(),
        )

    def flat(self) -> Floats:
        return self.network.flat()

    def average(self) -> Floats:
        return np.asarray(self._average.cpu().numpy(), np.float32).copy()

    def load_flat(self, vector: Floats) -> None:
        self.network.load_flat(vector)
        self._optimizer = self._new_optimizer()
        self._average = self._vector()

    def optimizer_state(self) -> tuple[Floats, Floats, int]:
        zeros = np.zeros_like(self.flat())
        states = [self._optimizer.state.get(p) for p in self.network.parameters()]
        if not all(states):
            return zeros, zeros.copy(), 0
        first, second = (
            torch.cat([state[name].reshape(-1) for state in states if state]).cpu().numpy()
            for name in ("exp_avg", "exp_avg_sq")
        )
        return first, second, int(states[0]["step"]) if states[0] else 0

    def load_optimizer_state(self, first: Floats, second: Floats, step: int) -> None:
        self._optimizer = self._new_optimizer()
        if not step:
            return
        at = 0
        for parameter in self.network.parameters():
            part = slice(at, at + parameter.numel())
            at = part.stop
            moments = (torch.from_numpy(m[part].copy()) for m in (first, second))
            average, squares = (m.reshape(parameter.shape).to(self.device) for m in moments)
            self._optimizer.state[parameter] = {
                "step": torch.tensor(float(step)),
                "exp_avg": average,
                "exp_avg_sq": squares,
            }
