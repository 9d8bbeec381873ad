"""Gauss-Newton's equations of measured points against a field, by whatever computes the field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.field.alignment import AlignmentSettings, NormalEquations
from meslam_core.field.kernel import KernelField
from meslam_core.field.model import LUMA, FieldModel

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def field_equations(
    field: FieldModel,
    points: Floats,
    arms_m: Floats,
    luma: Floats,
    weights: Floats,
    settings: AlignmentSettings,
) -> NormalEquations:
    """Equations of the signed distance and the luma at measured surface points.

    The compiled kernel sums them where it computes the field; any other field is probed and the
    same sums are formed here.

    Args:
        field: what the points are compared with.
        points: (N, 3) region coordinates.
        arms_m: (N, 3) from the camera centre to the points, map axes.
        luma: (N,) measured at the points.
        weights: (N,); a point with weight 0 is not used.
        settings: of the residuals.
    """
    if isinstance(field, KernelField):
        return field.normal_equations(points, arms_m, luma, weights, settings)
    values, gradient, luma_gradient = (x.astype(np.float64) for x in field.probe(points))
    gradient = gradient @ settings.to_map
    slope = np.linalg.norm(gradient, axis=1)
    usable = (weights > 0.0) & (np.abs(values[:, 0]) < settings.saturation)
    usable &= slope > settings.min_slope
    slope = np.maximum(slope, 1e-6)
    distance = (values[:, 0] - settings.surface_level) / slope
    confidence = weights * usable
    weight = confidence * _huber_weight(distance, settings.huber_m)
    jacobian = _pose_jacobian(gradient / slope[:, None], arms_m)
    information = (jacobian * weight[:, None]).T @ jacobian
    right_side = jacobian.T @ (weight * distance)
    scale = settings.color_weight
    if scale > 0.0:
        residual = values[:, 1:] @ np.array(LUMA) - luma
        weight = confidence * _huber_weight(scale * residual, settings.huber_m) * scale**2
        jacobian = _pose_jacobian(luma_gradient @ settings.to_map, arms_m)
        information = information + (jacobian * weight[:, None]).T @ jacobian
        right_side = right_side + jacobian.T @ (weight * residual)
    return NormalEquations(information, right_side, distance.astype(np.float32), usable)


def _pose_jacobian(direction: Doubles, arms_m: Floats) -> Doubles:
    """Derivative (N, 6) by (translation, rotation) of what changes along `direction` (N, 3)."""
    return np.concatenate([direction, np.cross(arms_m, direction)], axis=1)


def _huber_weight(residual: Doubles, threshold: float) -> Doubles:
    return np.minimum(1.0, threshold / np.maximum(np.abs(residual), 1e-12))
