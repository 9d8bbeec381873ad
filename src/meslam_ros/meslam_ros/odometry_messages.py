"""Odometry estimates of the camera as nav_msgs/Odometry of the base, and back."""

from __future__ import annotations

import threading
from bisect import bisect_left, insort

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray

from meslam_core import se3
from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.odometry import OdometryEstimate
from meslam_ros.conversions import NANOSECONDS, from_pose, stamp_ns, to_pose, to_stamp
from meslam_ros.transforms import CameraMount

UNKNOWN_VARIANCE = 9999.0
"""Variance of an estimate that must not be trusted, as in rtabmap's odometry messages."""
BUFFER_SIZE = 500
MAX_GAP_NS = NANOSECONDS // 5


def first_base_pose(mount: CameraMount) -> se3.Pose:
    """Pose (4, 4) of the first base in the map and odometry frames: x forward, z up (REP-103)."""
    return T_BODY_OPTICAL.copy() if mount.base_is_optical else np.eye(4)


class BaseMotion:
    """Turns the camera's odometry into the base's, with twist and growing covariance."""

    def __init__(self, odom_frame: str) -> None:
        self._odom_frame = odom_frame
        self._last: tuple[int, se3.Pose] | None = None
        self._covariance = np.zeros((6, 6))

    def message(self, estimate: OdometryEstimate, mount: CameraMount) -> Odometry:
        """The message of the next estimate.

        The pose's covariance is in the odometry frame's axes about the base, the twist's in the
        base's axes; both translation first. An invalid estimate has `UNKNOWN_VARIANCE` in both.
        """
        T_base_camera = mount.T_base_optical
        T_odom_base = se3.orthonormalized(
            first_base_pose(mount)
            @ T_base_camera
            @ estimate.T_odom_camera
            @ se3.inverse(T_base_camera)
        )
        twist, elapsed_s = np.zeros(6), 1.0
        motion_covariance = np.zeros((6, 6))
        if self._last is not None:
            last_ns, T_odom_last = self._last
            elapsed_s = max((estimate.stamp_ns - last_ns) / NANOSECONDS, 1e-3)
            twist = se3.log(se3.inverse(T_odom_last) @ T_odom_base) / elapsed_s
            adjoint = se3.adjoint(T_base_camera)
            motion_covariance = adjoint @ estimate.covariance @ adjoint.T
            self._grow(T_odom_last, T_odom_base, motion_covariance)
        self._last = estimate.stamp_ns, T_odom_base
        message = Odometry(child_frame_id=mount.base_frame)
        message.header.stamp = to_stamp(estimate.stamp_ns)
        message.header.frame_id = self._odom_frame
        message.pose.pose = to_pose(T_odom_base)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        linear.x, linear.y, linear.z = map(float, twist[:3])
        angular.x, angular.y, angular.z = map(float, twist[3:])
        unknown = np.eye(6) * UNKNOWN_VARIANCE
        message.pose.covariance = _flat(self._covariance if estimate.valid else unknown)
        message.twist.covariance = _flat(
            motion_covariance / elapsed_s**2 if estimate.valid else unknown
        )
        return message

    def _grow(
        self, T_odom_last: se3.Pose, T_odom_base: se3.Pose, motion: NDArray[np.float64]
    ) -> None:
        """Add a motion's uncertainty: what was uncertain in rotation moves the base sideways."""
        transport = np.eye(6)
        transport[:3, 3:] = -se3.hat(T_odom_base[:3, 3] - T_odom_last[:3, 3])
        axes = np.kron(np.eye(2), T_odom_base[:3, :3])
        self._covariance = transport @ self._covariance @ transport.T + axes @ motion @ axes.T


def _flat(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.ascontiguousarray(covariance, np.float64).reshape(36)


class OdometryBuffer:
    """Odometry messages by stamp, filled by the executor and waited for by the worker.

    Args:
        max_gap_ns: nothing is interpolated between messages that are farther apart [ns].

    Attributes:
        received: number of messages so far.
    """

    def __init__(self, max_gap_ns: int = MAX_GAP_NS) -> None:
        self.received = 0
        self._max_gap_ns = max_gap_ns
        self._stamps: list[int] = []
        self._messages: dict[int, Odometry] = {}
        self._number = 0
        self._began_ns: int | None = None
        self._changed = threading.Condition()

    def add(self, message: Odometry, number: int = 0) -> None:
        """Keep a message; the oldest ones are forgotten.

        Args:
            message: the next one.
            number: of the message among its publisher's. Smaller than the last one's, it tells of
                another publisher, whose poses have no connection to those before.
        """
        stamp = stamp_ns(message.header.stamp)
        with self._changed:
            self.received += 1
            began = number < self._number
            if began:
                self._began_ns = stamp
            self._number = number
            if began or (self._stamps and stamp < self._stamps[-1] - NANOSECONDS):
                self._stamps.clear()
                self._messages.clear()
            if stamp not in self._messages:
                insort(self._stamps, stamp)
            self._messages[stamp] = message
            for old in self._stamps[:-BUFFER_SIZE]:
                del self._messages[old]
            del self._stamps[:-BUFFER_SIZE]
            self._changed.notify_all()

    def began_anew(self, since_ns: int, until_ns: int) -> bool:
        """Whether another publisher's first message lies between two stamps [ns]."""
        began_ns = self._began_ns
        return began_ns is not None and since_ns < began_ns <= until_ns

    def wait(self, stamp: int, timeout_s: float) -> tuple[Odometry, ...]:
        """What is known of a stamp [ns].

        Args:
            stamp: of the image [ns].
            timeout_s: how long to wait for a message at or after the stamp [s].

        Returns:
            The message with this stamp, or its two neighbours where those are close; nothing when
            there is none in time.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: stamp in self._messages or (self._stamps and self._stamps[-1] > stamp),
                timeout_s,
            )
            if stamp in self._messages:
                return (self._messages[stamp],)
            place = bisect_left(self._stamps, stamp)
            if not 0 < place < len(self._stamps):
                return ()
            before, after = self._stamps[place - 1], self._stamps[place]
            if after - before > self._max_gap_ns:
                return ()
            return self._messages[before], self._messages[after]


def estimate_at(
    stamp: int, messages: tuple[Odometry, ...], mount: CameraMount
) -> OdometryEstimate | None:
    """The camera's odometry at a stamp [ns].

    Args:
        stamp: of the image [ns].
        messages: what is known of it (`OdometryBuffer.wait`).
        mount: of the camera on the base whose odometry it is.
    """
    if not messages:
        return None
    if len(messages) == 1:
        return from_odometry(messages[0], mount)
    return _interpolated(stamp, *messages, mount)


def from_odometry(message: Odometry, mount: CameraMount) -> OdometryEstimate:
    """The camera's estimate from an odometry message of the base.

    Raises:
        FrameError: when its numbers are no pose.
    """
    T_base_camera = mount.T_base_optical
    covariance = np.array(message.twist.covariance).reshape(6, 6)
    reason = ""
    if message.child_frame_id.lstrip("/") != mount.base_frame:
        reason = f"the odometry is of {message.child_frame_id!r}, the base is {mount.base_frame!r}"
    elif not np.isfinite(covariance).all() or np.diag(covariance).min() < 0.0:
        covariance = np.eye(6) * UNKNOWN_VARIANCE
        reason = "the odometry's covariance is none: not finite, or negative"
    elif covariance[0, 0] >= UNKNOWN_VARIANCE:
        reason = "the odometry says that it is not to be trusted"
    return OdometryEstimate(
        stamp_ns=stamp_ns(message.header.stamp),
        T_odom_camera=from_pose(message.pose.pose) @ T_base_camera,
        covariance=covariance,
        fitness=float(not reason),
        residual_m=0.0,
        valid=not reason,
        reason=reason,
    )


def _interpolated(
    stamp: int, first: Odometry, second: Odometry, mount: CameraMount
) -> OdometryEstimate:
    before, after = from_odometry(first, mount), from_odometry(second, mount)
    fraction = (stamp - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return OdometryEstimate(
        stamp_ns=stamp,
        T_odom_camera=se3.interpolate(before.T_odom_camera, after.T_odom_camera, fraction),
        covariance=after.covariance,
        fitness=after.fitness,
        residual_m=0.0,
        valid=before.valid and after.valid,
        reason=before.reason or after.reason,
    )
