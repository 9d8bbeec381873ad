"""External odometry: where the joint optimisation starts from (Sec. II-A)."""

from __future__ import annotations

from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.odometry.keyframe_odometry import KeyframeOdometry
from meslam_core.odometry.odometry import Odometry, OdometryEstimate
from meslam_core.odometry.registration import ColoredIcpRegistrar, HybridRegistrar, Registrar

__all__ = ["Odometry", "OdometryEstimate", "make_odometry"]


def make_odometry(odometry: OdometryConfig, sensor: SensorConfig) -> Odometry:
    """The odometry that the configuration names."""
    registrar: Registrar = HybridRegistrar(odometry, sensor)
    if odometry.method == "colored_icp":
        registrar = ColoredIcpRegistrar(odometry, sensor)
    return KeyframeOdometry(registrar, odometry, sensor)
