"""A lost camera is found when two frames agree."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.config import RelocalisationConfig
from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import Pose, exp
from meslam_core.tracking.recovery import Recovery

HERE = exp(np.array([1.0, -2.0, 0.5, 0.4, -0.3, 0.9]))
# 20 cm and 10 degrees from one frame to the next.
STEP = exp(np.array([0.2, 0.0, 0.0, 0.0, np.deg2rad(10.0), 0.0]))
FAR = exp(np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0]))
TURNED = exp(np.array([0.0, 0.0, 0.0, np.deg2rad(4.0), 0.0, 0.0]))
ODOM = exp(np.array([7.0, 0.0, 1.0, 0.0, 1.0, 0.0]))


def odometry(T_odom_camera: Pose, valid: bool = True) -> OdometryEstimate:
    return OdometryEstimate(0, T_odom_camera, np.eye(6), 1.0, 0.0, valid)


@pytest.fixture
def recovery() -> Recovery:
    return Recovery(RelocalisationConfig(agreement_m=0.05, agreement_deg=3.0))


def test_one_frame_alone_confirms_nothing(recovery):
    assert not recovery.confirms(HERE, odometry(ODOM))
    assert recovery.confirms(HERE @ STEP, odometry(ODOM @ STEP))


@pytest.mark.parametrize("off", [FAR, TURNED])
def test_another_place_than_odometry_says_is_not_confirmed(recovery, off):
    recovery.confirms(HERE, odometry(ODOM))
    assert not recovery.confirms(HERE @ STEP @ off, odometry(ODOM @ STEP))
    # The next one is held against the latest.
    assert recovery.confirms(HERE @ STEP @ off, odometry(ODOM @ STEP))


def test_without_valid_odometry_the_camera_stands_still(recovery):
    recovery.confirms(HERE, odometry(ODOM))
    assert not recovery.confirms(HERE @ STEP, odometry(ODOM @ STEP, valid=False))
    assert recovery.confirms(HERE @ STEP, None)


def test_a_frame_that_was_not_recognised_in_between_starts_anew(recovery):
    recovery.confirms(HERE, odometry(ODOM))
    recovery.reset()
    assert not recovery.confirms(HERE @ STEP, odometry(ODOM @ STEP))
