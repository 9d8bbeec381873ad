"""Faults of images, stamps and calibration."""

from __future__ import annotations

import numpy as np
from faults.expectations import each, refused, tracked, walked
from faults.fault import Fault, Group
from faults.material import FRAMES, Shot


def _nan(shot: Shot) -> None:
    shot.depth = shot.depth.astype(np.float32) / 1000
    shot.depth[::3] = np.nan
    shot.depth[1::7] = np.inf
    shot.depth[2::11] = -1.0


def _zeros(shots: list[Shot]) -> None:
    for shot in shots:
        shot.depth[:] = 0


FAULTS = (
    Fault(
        name="depth-nan",
        group=Group.INPUT,
        injected="half of all depth pixels are NaN, infinite or negative",
        expected="they are holes; every frame is tracked",
        inject=walked(each(_nan)),
        problem=tracked(FRAMES),
        quick=True,
    ),
    Fault(
        name="depth-all-zero",
        group=Group.INPUT,
        injected="every depth image is empty",
        expected="status 3; the message says that there is no depth",
        inject=walked(_zeros),
        problem=refused("depth", status=3),
    ),
)
