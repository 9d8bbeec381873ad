"""External odometry: where the joint optimisation starts from (Sec. II-A)."""

from __future__ import annotations

import logging

from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.odometry import direct
from meslam_core.odometry.direct import DirectRegistrar
from meslam_core.odometry.given_odometry import GivenOdometry, NoOdometry, given_noise
from meslam_core.odometry.keyframe_odometry import KeyframeOdometry
from meslam_core.odometry.odometry import MotionNoise, Odometry, OdometryEstimate
from meslam_core.odometry.registration import (
    ColoredIcpRegistrar,
    HybridRegistrar,
    Registrar,
    Registration,
)

__all__ = [
    "GivenOdometry",
    "MotionNoise",
    "Odometry",
    "OdometryEstimate",
    "Registration",
    "given_noise",
    "make_odometry",
    "make_registrar",
]

logger = logging.getLogger(__name__)


def make_odometry(odometry: OdometryConfig, sensor: SensorConfig) -> Odometry:
    """The odometry that the configuration names."""
    if odometry.method == "none":
        return NoOdometry()
    return KeyframeOdometry(make_registrar(odometry, sensor), odometry, sensor)


def make_registrar(odometry: OdometryConfig, sensor: SensorConfig) -> Registrar:
    """The registration of images that the configuration names."""
    if odometry.method == "colored_icp":
        return ColoredIcpRegistrar(odometry, sensor)
    if odometry.method == "hybrid":
        return HybridRegistrar(odometry, sensor)
    reason = direct.unavailable_reason()
    if reason:
        logger.warning("odometry.method = direct: %s; using Open3D's hybrid method", reason)
        return HybridRegistrar(odometry, sensor)
    return DirectRegistrar(odometry, sensor)
