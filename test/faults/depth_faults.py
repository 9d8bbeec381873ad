"""Depth images that are wrong: values, unit, stuck cameras."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from faults.expectations import (
    Problem,
    each,
    tracked,
    untracked,
    walked,
)
from faults.fault import Group, Seen, faults_of
from faults.material import FRAMES, WHILE, Shot


def _metres(shot: Shot) -> None:
    shot.depth = shot.depth.astype(np.float32) / 1000


def _nan(shot: Shot) -> None:
    _metres(shot)
    shot.depth[::3] = np.nan
    shot.depth[1::7] = np.inf
    shot.depth[2::11] = -1.0


def _scaled(factor: float) -> Callable[[Shot], None]:
    def scale(shot: Shot) -> None:
        shot.depth = np.rint(shot.depth * factor).astype(np.uint16)

    return scale


def _as_float_millimetres(shot: Shot) -> None:
    shot.depth = shot.depth.astype(np.float32)


def _filled(value: int) -> Callable[[Shot], None]:
    def fill(shot: Shot) -> None:
        shot.depth[:] = value

    return fill


def _half_saturated(shot: Shot) -> None:
    shot.depth[:, ::2] = 65535


def _speckled(shot: Shot) -> None:
    generator = np.random.default_rng(shot.stamp_ns % 1000)
    wrong = generator.random(shot.depth.shape) < 0.2
    shot.depth[wrong] = generator.integers(1, 65535, np.count_nonzero(wrong))


def _frozen_depth(taken: list[Shot]) -> None:
    for shot in taken[WHILE]:
        shot.depth = taken[WHILE.start].depth


def _degraded(at_least: int) -> Problem:
    """So many frames are DEGRADED, the others tracked."""

    def problem(seen: Seen) -> str:
        if told := tracked(FRAMES - 6, within_m=0.05)(seen):
            return told
        degraded = seen.facts["report"]["frames_degraded"]
        return "" if degraded >= at_least else f"only {degraded} frames DEGRADED"

    return problem


_fault = faults_of(Group.INPUT)

DEPTH = (
    _fault(
        "depth-nan",
        "half of all depth pixels are NaN, infinite or negative",
        "they are holes; every frame is tracked",
        walked(each(_nan)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-all-zero",
        "every depth image is empty",
        "status 3, no map; the message says that the depth image is empty",
        walked(each(_filled(0))),
        untracked("the depth image is empty"),
    ),
    _fault(
        "depth-saturated",
        "every depth pixel has the largest value",
        "status 3, no map; the message gives the value and says that the camera is stuck",
        walked(each(_filled(65535))),
        untracked("65.5", "stuck"),
    ),
    _fault(
        "depth-half-saturated",
        "every second column of depth has the largest value",
        "these pixels are out of range; every frame is tracked",
        walked(each(_half_saturated)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-all-equal",
        "six depth images in the middle have the same value everywhere",
        "these frames are DEGRADED and train nothing; no pose of odometry's is off by 5 cm",
        walked(each(_filled(1500), WHILE.start, WHILE.stop)),
        _degraded(4),
    ),
    _fault(
        "depth-all-equal-from-the-start",
        "all depth images have the same value everywhere",
        "status 3, no map; the message says that the camera is stuck",
        walked(each(_filled(1500))),
        untracked("1.5 m", "stuck"),
    ),
    _fault(
        "depth-frozen",
        "the driver repeats one depth image for six frames while colour goes on",
        "no pose that is said to be good is off by more than 5 cm; the rest is tracked",
        walked(_frozen_depth),
        tracked(FRAMES - 6, within_m=0.05),
    ),
    _fault(
        "depth-speckled",
        "a fifth of all depth pixels have random values",
        "every frame is tracked",
        walked(each(_speckled)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-millimetres-as-metres",
        "32FC1 images hold millimetres",
        "status 3, no map; the message names the unit and the remedy",
        walked(each(_as_float_millimetres)),
        untracked("millimetres taken as metres", "REP-118"),
        quick=True,
    ),
    _fault(
        "depth-metres-as-millimetres",
        "16UC1 images hold whole metres",
        "status 3, no map; the message names the remedy",
        walked(each(_scaled(0.001))),
        untracked("REP-118", "millimetres"),
    ),
    _fault(
        "depth-in-tenths-of-millimetres",
        "16UC1 images hold tenths of millimetres, as some cameras send",
        "status 3, no map; the message doubts the unit and names the remedy",
        walked(each(_scaled(10))),
        untracked("is that its unit", "REP-118"),
    ),
    _fault(
        "depth-five-times-too-small",
        "16UC1 images hold a fifth of the depth: a doll's house",
        "it is tracked, for scale cannot be seen; a warning doubts the unit, names the remedy",
        walked(each(_scaled(0.2))),
        tracked(FRAMES, "is that its unit", "depth_scale_m", within_m=1.0),
    ),
)


FAULTS = DEPTH
