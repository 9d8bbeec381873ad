"""Calibrations that are missing, wrong or changing, and topics that are missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from data.bag_builder import ALIGNED_DEPTH, COLOR, COLOR_INFO, BagBuilder
from faults.expectations import (
    built,
    each,
    refused,
    tracked,
    walked,
)
from faults.fault import Group, faults_of
from faults.material import MIDDLE, Shot


def _with_camera(**values: float) -> Callable[[Shot], None]:
    def change(shot: Shot) -> None:
        shot.camera = replace(shot.camera, **values)

    return change


def _color_alone(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")


def _depth_alone(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth, "16UC1")


def _without_info(builder: BagBuilder, shot: Shot) -> None:
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth, "16UC1")


def _with_matrix(k: np.ndarray) -> Callable[[BagBuilder, Shot], None]:
    def build(builder: BagBuilder, shot: Shot) -> None:
        _without_info(builder, shot)
        builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera, k=k)

    return build


_fault = faults_of(Group.INPUT)

CALIBRATION = (
    _fault(
        "camera-info-changes",
        "in the middle the camera info's focal length grows by a third",
        "a warning says when it changed and that the first one is used",
        walked(each(_with_camera(fx=170.0), MIDDLE)),
        tracked(1, "camera info", "changes", within_m=0.05),
    ),
    _fault(
        "intrinsics-wrong",
        "the camera info's focal lengths are a fifth too large",
        "it runs; no pose said to be good is off by more than 10 cm",
        walked(each(_with_camera(fx=156.0, fy=156.0))),
        tracked(1, within_m=0.10),
    ),
    _fault(
        "intrinsics-zero",
        "the camera info's matrix is zero: an uncalibrated camera",
        "refused; the message says how to give intrinsics",
        built(_with_matrix(np.zeros((3, 3)))),
        refused("no intrinsics", "--camera"),
    ),
    _fault(
        "intrinsics-nan",
        "the camera info's matrix holds NaN",
        "refused; the message says how to give intrinsics",
        built(_with_matrix(np.full((3, 3), np.nan))),
        refused("no intrinsics", "--camera"),
    ),
    _fault(
        "camera-info-missing",
        "there is no camera info",
        "refused; the message says how to give intrinsics",
        built(_without_info),
        refused("no camera info", "--camera"),
    ),
    _fault(
        "depth-topic-missing",
        "the recording has colour alone",
        "refused; the message lists the image topics",
        built(_color_alone),
        refused("no depth images", COLOR),
    ),
    _fault(
        "colour-topic-missing",
        "the recording has depth alone",
        "refused; the message lists the image topics",
        built(_depth_alone),
        refused("no colour images", ALIGNED_DEPTH),
    ),
)


FAULTS = CALIBRATION
