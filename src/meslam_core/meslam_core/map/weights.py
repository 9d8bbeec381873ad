"""A region's weights to tensors and back, exact or in fewer bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.field.network import parameter_shapes
from meslam_core.map.sensitivity import row_sensitivities
from meslam_core.map.stored_region import Architecture, StoredRegion

PHASE_LIMIT = 3.1416  # a little above pi, so that quantised phases stay as they are
TOLERANCE = 2e-4
LEAST_SENSITIVITY = 0.1

SCALE = ".scale"
INT8_LIMIT, INT16_LIMIT = 127, 32767
SCALE_MANTISSA_BITS = 5
ENCODING = ("encoding.frequencies", "encoding.phases")

Tensors = dict[str, NDArray[Any]]


def weights_to_tensors(region: StoredRegion, precision: str, name: str) -> Tensors:
    """The tensors that `docs/map-format.md` lists, in the order of the flat vector.

    Raises:
        MapError: when the weights do not fit the precision.
    """
    weights = _named(region)
    if precision == "fp32":
        return dict(weights)
    steps = _row_steps(region, weights) if precision == "int8" else {}
    tensors: Tensors = {}
    for key, values in weights.items():
        if key == "encoding.phases":
            turned = np.remainder(values.astype(np.float64) + np.pi, 2 * np.pi) - np.pi
            values = np.where(np.abs(values) > PHASE_LIMIT, turned, values).astype(np.float32)
        if key in ENCODING:
            tensors |= _as_int16(key, values)
        elif key in steps:
            tensors |= _as_int8(key, values, steps[key])
        else:
            with np.errstate(over="ignore"):
                tensors[key] = values.astype(np.float16)
            if not np.isfinite(tensors[key]).all():
                raise MapError(f"{name}: weights are too large for {precision}; store fp32")
    return tensors


def weights_from_tensors(
    tensors: Tensors, architecture: Architecture, name: str
) -> NDArray[np.float32]:
    """The flat vector; one float32 product a weight, so that every machine gets the same bits.

    Args:
        tensors: from which those of the weights are taken out.
        architecture: of the network.
        name: for messages.

    Raises:
        MapError: when a tensor is missing or malformed.
    """
    parts = []
    for key, shape in parameter_shapes(architecture.width, architecture.embedding).items():
        stored, scale = tensors.pop(key, None), tensors.pop(key + SCALE, None)
        if stored is None or stored.shape != shape:
            raise MapError(f"{name}: tensor {key!r} is missing or not of shape {shape}")
        values = stored.astype(np.float32)
        if stored.dtype in (np.int8, np.int16):
            rows = values.reshape(1 if key in ENCODING else shape[0], -1)
            if scale is None or scale.dtype != np.float32 or scale.shape != (len(rows),):
                raise MapError(f"{name}: tensor {key + SCALE!r} is missing or malformed")
            with np.errstate(invalid="ignore", over="ignore"):  # checked below
                values = rows * scale[:, None]
        elif stored.dtype not in (np.float16, np.float32) or scale is not None:
            raise MapError(f"{name}: tensor {key!r} has an unknown type {stored.dtype}")
        parts.append(values.reshape(-1))
    parameters = np.concatenate(parts)
    if not np.isfinite(parameters).all():
        raise MapError(f"{name}: weights are not finite; the content is damaged")
    return parameters


def _named(region: StoredRegion) -> dict[str, NDArray[np.float32]]:
    """The flat vector's parts by name."""
    named, start = {}, 0
    shapes = parameter_shapes(region.architecture.width, region.architecture.embedding)
    for key, shape in shapes.items():
        size = int(np.prod(shape))
        named[key] = region.parameters[start : start + size].reshape(shape).astype(np.float32)
        start += size
    return named


def _row_steps(
    region: StoredRegion, weights: dict[str, NDArray[np.float32]]
) -> dict[str, NDArray[np.float64]]:
    """Quantisation steps (R,) of the hidden layers' rows.

    The steps make each weight's rounding change the answers by the same amount, so that no
    bits are spent on weights that matter little.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        sensitivities = row_sensitivities(region, weights)
    steps = {}
    for key, sensitivity in sensitivities.items():
        known = np.nan_to_num(sensitivity, posinf=0.0)
        felt = np.maximum(known, max(LEAST_SENSITIVITY * known.max(), np.finfo(np.float32).tiny))
        steps[key] = TOLERANCE / felt
    return steps


def _as_int8(key: str, rows: NDArray[np.float32], steps: NDArray[np.float64]) -> Tensors:
    """Integers and a float32 scale a row, about as large as its step.

    Integer times scale is exact in float32, for scales have few bits of mantissa. Rows that
    are such products already are kept as they are, so that encoding a decoded region again
    gives the same bytes.
    """
    wide = rows.astype(np.float64)
    needed = np.abs(wide).max(axis=1) / INT8_LIMIT
    mantissa, exponent = np.frexp(np.maximum(np.where(needed > 0, steps, 0.0), needed))
    unit = 2.0**SCALE_MANTISSA_BITS
    scale = np.ldexp(np.ceil(mantissa * unit) / unit, exponent)
    stored = _common_divisors(wide)
    scale = np.where(stored > 0, stored, scale).astype(np.float32).astype(np.float64)
    integers = np.rint(wide / np.where(scale > 0, scale, 1.0)[:, None]).astype(np.int64)
    shared = np.gcd.reduce(integers, axis=1)
    integers //= np.maximum(shared, 1)[:, None]
    return {key: integers.astype(np.int8), key + SCALE: (scale * shared).astype(np.float32)}


def _common_divisors(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest number (R,) that divides all of a row into int8 integers; 0 where none does."""
    largest = np.abs(rows).max(axis=1)
    unit = np.ldexp(1.0, np.frexp(largest)[1] - SCALE_MANTISSA_BITS - 2 * 8)
    units = rows / np.where(largest > 0, unit, 1.0)[:, None]
    whole = (units == np.rint(units)).all(axis=1) & (largest > 0)
    divisor = np.gcd.reduce(np.where(whole[:, None], units, 1.0).astype(np.int64), axis=1)
    divides = whole & (np.abs(units).max(axis=1) <= divisor * INT8_LIMIT)
    return np.where(divides, divisor * unit, 0.0)


def _as_int16(key: str, values: NDArray[np.float32]) -> Tensors:
    """Integers and one float32 scale, a power of two, so that encoding again changes nothing."""
    exponent = np.frexp(float(np.abs(values).max()) / INT16_LIMIT)[1]
    scale = np.float32(np.ldexp(1.0, int(exponent))) if values.any() else np.float32(0)
    divisor = np.float64(scale) if scale > 0 else np.float64(1)
    integers = np.clip(np.rint(values / divisor), -INT16_LIMIT, INT16_LIMIT)
    return {key: integers.astype(np.int16), key + SCALE: np.array([scale], np.float32)}
