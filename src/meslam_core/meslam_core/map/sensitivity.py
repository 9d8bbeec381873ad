"""How much a network's answers change with its weights, near the surfaces it was trained on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

POINTS = 4096
NEAR_SHARE = 0.9
COLOR_WEIGHT = 0.3

Matrix = NDArray[np.float32]
Weights = dict[str, NDArray[np.float32]]


def row_sensitivities(region: StoredRegion, weights: Weights) -> dict[str, NDArray[np.float64]]:
    """By how much the answers change when one weight of a row changes by one.

    That is the root mean square, over points and the row's columns, of the derivatives of f and
    (less important) of colour.

    Args:
        region: whose mask tells where its answers count.
        weights: its parameters by name, in their shapes.

    Returns:
        For each hidden layer's weight matrix (R, C), by its name: (R,).
    """
    points = _points(region)
    embedded = np.sin(points @ weights["encoding.frequencies"].T + weights["encoding.phases"])
    first = _layer(weights, "layer1", embedded)
    second = _layer(weights, "layer2", first)
    joined = np.concatenate([second, embedded], axis=1)
    third = _layer(weights, "layer3", joined)
    fourth = _layer(weights, "layer4", third)
    inputs = {"layer1": embedded, "layer2": first, "layer3": joined, "layer4": third}
    outputs = {"layer1": first, "layer2": second, "layer3": third, "layer4": fourth}
    squares = {name: np.zeros_like(values) for name, values in outputs.items()}
    for row, slope in zip(weights["head.weight"], _output_slopes(weights, fourth), strict=True):
        back = slope[:, None] * row
        for name in ("layer4", "layer3", "layer2", "layer1"):
            back = back[:, : outputs[name].shape[1]] * (outputs[name] > 0)
            squares[name] += back * back
            back = back @ weights[f"{name}.weight"]
    return {
        f"{name}.weight": np.sqrt(
            (squares[name].T @ (inputs[name] ** 2)).astype(np.float64).mean(axis=1) / len(points)
        )
        for name in inputs
    }


def _layer(weights: Weights, name: str, inputs: Matrix) -> Matrix:
    product: Matrix = inputs @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]
    return np.maximum(product, 0)


def _output_slopes(weights: Weights, hidden: Matrix) -> Matrix:
    """Derivative (4, N) of f and colour with respect to the head's outputs, as they count."""
    outputs = hidden @ weights["head.weight"].T + weights["head.bias"]
    slopes = np.ones_like(outputs.T)
    colors = 1 / (1 + np.exp(-np.clip(outputs[:, 1:].T, -20, 20)))
    slopes[1:] = COLOR_WEIGHT * colors * (1 - colors)
    return slopes


def _points(region: StoredRegion) -> Matrix:
    """Points (N, 3) in region coordinates, most of them near surfaces; the same every time."""
    generator = np.random.default_rng(0)
    mask, found = region.mask, []
    for flag, share in ((NEAR_SURFACE, NEAR_SHARE), (OBSERVED, 1.0 - NEAR_SHARE)):
        voxels = np.argwhere(mask.flags & flag)
        if len(voxels):
            chosen = voxels[generator.integers(0, len(voxels), round(POINTS * share))]
            inside = generator.random(chosen.shape)
            found.append((chosen + inside) * mask.voxel_m - mask.half_extent_m)
    if not found:
        found.append(generator.uniform(-region.half_side_m, region.half_side_m, (POINTS, 3)))
    return (np.concatenate(found) / region.half_side_m).astype(np.float32)
