"""A region's network: the readable reference of what the compiled kernel computes."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.field.encoding import GaussianEncoding

OUTPUTS = 4


class FieldNetwork(torch.nn.Module):
    """Embedding, four ReLU layers with the embedding again at the third, four outputs.

    Output 0 is the truncated signed distance f (positive behind the surface), whose positive
    part gives density; outputs 1 to 3 are red, green, blue after a sigmoid (Fig. 3 of the paper).

    Args:
        config: width of the layers and size of the embedding.
        seed: of the initial weights.
    """

    def __init__(self, config: FieldConfig, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        width, embedding = config.width, config.embedding
        self.encoding = GaussianEncoding(embedding, config.embedding_sigma, generator)
        self.layer1 = torch.nn.Linear(embedding, width)
        self.layer2 = torch.nn.Linear(width, width)
        self.layer3 = torch.nn.Linear(width + embedding, width)
        self.layer4 = torch.nn.Linear(width, width)
        self.head = torch.nn.Linear(width, OUTPUTS)
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4, self.head):
            bound = (6.0 / layer.in_features) ** 0.5
            with torch.no_grad():
                uniform = torch.rand(layer.weight.shape, generator=generator)
                layer.weight.copy_((uniform * 2 - 1) * bound)
                layer.bias.zero_()
        with torch.no_grad():
            self.head.weight.mul_(0.1)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """f and colour (N, 4) at points (N, 3) in region coordinates."""
        encoded = self.encoding(points)
        hidden = torch.relu(self.layer1(encoded))
        hidden = torch.relu(self.layer2(hidden))
        hidden = torch.relu(self.layer3(torch.cat([hidden, encoded], dim=-1)))
        hidden = torch.relu(self.layer4(hidden))
        output = self.head(hidden)
        return torch.cat([output[:, :1], torch.sigmoid(output[:, 1:])], dim=-1)

    def flat(self) -> NDArray[np.float32]:
        """All parameters as one vector, in the layout of `parameter_shapes`."""
        with torch.no_grad():
            parts = [p.detach().reshape(-1).cpu() for p in self.parameters()]
            return torch.cat(parts).numpy().astype(np.float32)

    def load_flat(self, vector: NDArray[np.float32]) -> None:
        """Set all parameters from one vector of the same layout."""
        tensor = torch.from_numpy(np.array(vector, dtype=np.float32))
        with torch.no_grad():
            torch.nn.utils.vector_to_parameters(
                tensor.to(next(self.parameters()).device), self.parameters()
            )


def parameter_shapes(width: int, embedding: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's parameters in the order of the flat vector."""
    return {
        "encoding.frequencies": (embedding, 3),
        "encoding.phases": (embedding,),
        "layer1.weight": (width, embedding),
        "layer1.bias": (width,),
        "layer2.weight": (width, width),
        "layer2.bias": (width,),
        "layer3.weight": (width, width + embedding),
        "layer3.bias": (width,),
        "layer4.weight": (width, width),
        "layer4.bias": (width,),
        "head.weight": (OUTPUTS, width),
        "head.bias": (OUTPUTS,),
    }


def parameter_count(width: int, embedding: int) -> int:
    """Length of a network's flat vector."""
    return sum(int(np.prod(shape)) for shape in parameter_shapes(width, embedding).values())


def shifted(
    vector: NDArray[np.float32], embedding: int, offset: NDArray[np.floating]
) -> NDArray[np.float32]:
    """The same field about an origin moved by `offset` (3,), region coordinates.

    The result at x equals the given field at x + offset, exactly (see `GaussianEncoding`).
    """
    result = np.array(vector, dtype=np.float32)
    frequencies = result[: 3 * embedding].reshape(embedding, 3).astype(np.float64)
    phases = result[3 * embedding : 4 * embedding]
    moved = phases + frequencies @ np.asarray(offset, np.float64)
    phases[:] = np.remainder(moved + np.pi, 2 * np.pi) - np.pi
    return result
