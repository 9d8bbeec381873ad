from __future__ import annotations

import threading

import numpy as np
import pytest

from meslam_core.odometry import OdometryEstimate
from meslam_core.se3 import exp, inverse, log
from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros.conversions import NANOSECONDS, from_pose
from meslam_ros.odometry_messages import (
    UNKNOWN_VARIANCE,
    BaseMotion,
    OdometryBuffer,
    estimate_at,
    from_odometry,
)
from meslam_ros.transforms import CameraMount

MOUNT = CameraMount(
    "base", "optical", exp(np.array([0.2, 0.0, 0.3, 0.0, 0.1, 0.0])) @ T_BODY_OPTICAL
)
PERIOD_NS = NANOSECONDS // 10
STEP = exp(np.array([0.01, 0.0, 0.02, 0.0, 0.05, 0.0]))
COVARIANCE = np.diag([1e-6, 1e-6, 4e-6, 1e-7, 1e-7, 1e-7])


def estimate(number: int, valid: bool = True) -> OdometryEstimate:
    return OdometryEstimate(
        stamp_ns=number * PERIOD_NS,
        T_odom_camera=np.linalg.matrix_power(STEP, number),
        covariance=COVARIANCE,
        fitness=0.9,
        residual_m=0.01,
        valid=valid,
        reason="" if valid else "only 10% of the points match",
    )


def messages(count: int) -> list:
    motion = BaseMotion("odom")
    return [motion.message(estimate(number), MOUNT) for number in range(count)]


def test_base_starts_at_the_origin_and_moves_as_the_camera_does() -> None:
    first, *_, last = messages(4)
    np.testing.assert_allclose(from_pose(first.pose.pose), np.eye(4), atol=1e-12)
    T_base_camera = MOUNT.T_base_optical
    expected = T_base_camera @ estimate(3).T_odom_camera @ inverse(T_base_camera)
    np.testing.assert_allclose(from_pose(last.pose.pose), expected, atol=1e-9)
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base")


def test_camera_without_base_starts_looking_along_x() -> None:
    mount = CameraMount("optical", "optical", np.eye(4))
    message = BaseMotion("odom").message(estimate(0), mount)
    np.testing.assert_allclose(from_pose(message.pose.pose), T_BODY_OPTICAL, atol=1e-12)


def test_twist_is_the_bases_velocity_in_its_own_axes() -> None:
    first, second = messages(2)
    motion = inverse(from_pose(first.pose.pose)) @ from_pose(second.pose.pose)
    twist = second.twist.twist
    measured = [
        *(getattr(twist.linear, axis) for axis in "xyz"),
        *(getattr(twist.angular, axis) for axis in "xyz"),
    ]
    np.testing.assert_allclose(measured, log(motion) / 0.1, atol=1e-9)


def test_covariances_are_proper_and_the_poses_grows() -> None:
    traces = []
    for message in messages(5)[1:]:
        for covariance in (message.pose.covariance, message.twist.covariance):
            matrix = np.array(covariance).reshape(6, 6)
            np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
            assert np.linalg.eigvalsh(matrix).min() > 0
        traces.append(np.trace(np.array(message.pose.covariance).reshape(6, 6)))
    assert traces == sorted(traces)


def test_estimate_survives_the_way_over_the_base() -> None:
    received = from_odometry(messages(4)[3], MOUNT)
    start = from_odometry(messages(1)[0], MOUNT)
    motion = inverse(start.T_odom_camera) @ received.T_odom_camera
    np.testing.assert_allclose(motion, estimate(3).T_odom_camera, atol=1e-9)
    assert received.stamp_ns == 3 * PERIOD_NS
    assert received.valid


def test_invalid_estimate_says_so_to_everyone() -> None:
    message = BaseMotion("odom").message(estimate(1, valid=False), MOUNT)
    assert message.pose.covariance[0] == UNKNOWN_VARIANCE
    assert message.twist.covariance[0] == UNKNOWN_VARIANCE
    received = from_odometry(message, MOUNT)
    assert not received.valid
    assert received.reason


def test_odometry_of_another_frame_is_not_used() -> None:
    other = CameraMount("wheels", "optical", MOUNT.T_base_optical)
    received = from_odometry(messages(1)[0], other)
    assert not received.valid
    assert "wheels" in received.reason


def test_buffer_answers_equal_stamps_at_once_and_waits_for_late_ones() -> None:
    buffer = OdometryBuffer()
    first, second = messages(2)
    buffer.add(first)
    found = estimate_at(0, buffer.wait(0, 0.0), MOUNT)
    assert found is not None
    assert found.stamp_ns == 0
    assert estimate_at(PERIOD_NS, buffer.wait(PERIOD_NS, 0.0), MOUNT) is None
    threading.Timer(0.1, buffer.add, (second,)).start()
    late = estimate_at(PERIOD_NS, buffer.wait(PERIOD_NS, 5.0), MOUNT)
    assert late is not None
    assert late.stamp_ns == PERIOD_NS


def test_faster_odometry_is_interpolated() -> None:
    buffer = OdometryBuffer()
    for message in messages(3):
        buffer.add(message)
    between = estimate_at(PERIOD_NS // 2, buffer.wait(PERIOD_NS // 2, 0.0), MOUNT)
    assert between is not None
    start = from_odometry(messages(1)[0], MOUNT)
    motion = log(inverse(start.T_odom_camera) @ between.T_odom_camera)
    np.testing.assert_allclose(motion, 0.5 * log(STEP), atol=1e-9)


def test_the_longest_gap_is_the_users() -> None:
    patient, strict = OdometryBuffer(PERIOD_NS), OdometryBuffer(PERIOD_NS - 1)
    for message in messages(2):
        patient.add(message)
        strict.add(message)
    assert len(patient.wait(PERIOD_NS // 2, 0.0)) == 2
    assert strict.wait(PERIOD_NS // 2, 0.0) == ()


@pytest.mark.parametrize("stamp", [-PERIOD_NS, 20 * PERIOD_NS])
def test_nothing_is_invented_outside_what_came(stamp: int) -> None:
    buffer = OdometryBuffer()
    for message in messages(3):
        buffer.add(message)
    assert buffer.wait(stamp, 0.0) == ()


def test_odometry_that_starts_again_forgets_what_was() -> None:
    buffer = OdometryBuffer()
    for number in (100, 0):
        buffer.add(BaseMotion("odom").message(estimate(number), MOUNT))
    assert buffer.wait(100 * PERIOD_NS, 0.0) == ()
    assert len(buffer.wait(0, 0.0)) == 1
