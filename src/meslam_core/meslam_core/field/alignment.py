"""What aligning a frame with a field takes and gives: residuals' settings, normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class AlignmentSettings:
    """How residuals of a frame against the field are formed and weighted.

    Attributes:
        to_map: (3, 3) float64; a gradient (row) by region coordinates times it is one by map
            coordinates [1/m].
        surface_level: f on the surface.
        saturation: points with |f| from this on are not used.
        min_slope: nor are those where f is flatter [1/m].
        huber_m: robust threshold [m].
        color_weight: scale of the colour residual; 0 switches it off.
    """

    to_map: NDArray[np.float64]
    surface_level: float
    saturation: float
    min_slope: float
    huber_m: float
    color_weight: float


@dataclass(frozen=True)
class NormalEquations:
    """Of (translation [m], rotation [rad]) about the camera centre, map axes.

    Attributes:
        information: (6, 6) float64, the weighted sum of J^T J.
        gradient: (6,) float64, the weighted sum of J^T residual.
        distance_m: (N,) float32, from the mapped surface, positive behind it.
        usable: (N,) which points took part.
    """

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    distance_m: Floats
    usable: NDArray[np.bool_]
