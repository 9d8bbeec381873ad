"""Odometry against a keyframe, with checks on every result (Sec. II-A).

Registering against the last keyframe instead of the last frame drifts several times less, and
the last motion as a first guess keeps fast rotation within the registration's basin.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import OdometryConfig, SensorConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry.odometry import OdometryEstimate
from meslam_core.odometry.registration import Registrar, Registration
from meslam_core.se3 import Pose, exp, inverse, log, orthonormalized, rotation_angle

logger = logging.getLogger(__name__)

UNKNOWN_VARIANCE = 1.0
# Within such a motion between two frames the alignment finds the right answer from any guess.
SAFE_MOTION_M = 0.04
SAFE_TURN_RAD = 0.05
# A motion that differs so little from its prediction came as expected.
EXPECTED_MOTION_M = 0.01
EXPECTED_TURN_RAD = 0.0125
# A registration that starts so near to where another one ended ends there, too. Wider limits
# (2 cm) would miss better results along plain walls.
SAME_MOTION_M = 0.006
SAME_TURN_RAD = 0.006
# Over a gap of so long [s] a motion farther than this is a guess: two views that share little fit
# in several ways. Of 301 registered pairs 1.4 s apart and more 26 were wrong by 15 cm or 8 degrees,
# all by such motions; of about 120 up to 1 s apart none was.
GAP_S = 0.8
GAP_MOTION_M = 0.5
GAP_TURN_RAD = 0.5
NANOSECONDS = 1e-9


class KeyframeOdometry:
    """Chains registrations against odometry keyframes.

    Args:
        registrar: the registration.
        odometry, sensor: thresholds.
    """

    def __init__(
        self, registrar: Registrar, odometry: OdometryConfig, sensor: SensorConfig
    ) -> None:
        self._registrar = registrar
        self._config = odometry
        self._sensor = sensor
        self._keyframe: Any = None
        self._previous: Any = None
        self._T_odom_keyframe: Pose = np.eye(4)
        self._T_odom_last: Pose = np.eye(4)
        self._velocity: NDArray[np.float64] = np.zeros(6)
        self._last_stamp_ns: int | None = None
        self._failures = 0

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        """Register the next frame; the first one is the origin of the odometry frame."""
        prepared = self._registrar.prepare(frame)
        if self._last_stamp_ns is None:
            self._keyframe = self._previous = prepared
            self._last_stamp_ns = frame.stamp_ns
            return OdometryEstimate(
                frame.stamp_ns, np.eye(4), np.eye(6) * 1e-8, 1.0, 0.0, valid=True
            )
        elapsed_s = max((frame.stamp_ns - self._last_stamp_ns) * NANOSECONDS, 1e-3)
        guess = orthonormalized(self._T_odom_last @ exp(self._velocity * elapsed_s))
        registration, reason = self._register(prepared, guess, elapsed_s)
        T_odom_camera = guess
        if not reason:
            T_odom_camera = orthonormalized(self._T_odom_keyframe @ registration.T_target_source)
        motion = inverse(self._T_odom_last) @ T_odom_camera
        leaps = not reason and elapsed_s > GAP_S and _exceeds(motion, GAP_MOTION_M, GAP_TURN_RAD)
        if leaps:
            reason = f"no image for {elapsed_s:.1f} s, and a motion that may be another one"
        valid = not reason
        self._velocity = np.asarray(log(motion) / elapsed_s if valid else 0.5 * self._velocity)
        self._T_odom_last, self._last_stamp_ns = T_odom_camera, frame.stamp_ns
        self._failures = 0 if valid else self._failures + 1
        self._previous = prepared
        if leaps or self._is_new_keyframe(T_odom_camera, registration, valid):
            self._keyframe, self._T_odom_keyframe = prepared, T_odom_camera
        return OdometryEstimate(
            stamp_ns=frame.stamp_ns,
            T_odom_camera=T_odom_camera,
            covariance=_covariance(registration, valid),
            fitness=registration.fitness,
            residual_m=registration.residual_m,
            valid=valid,
            reason=reason,
        )

    def _register(self, prepared: Any, guess: Pose, elapsed_s: float) -> tuple[Registration, str]:
        """Register against the keyframe, harder where that is doubtful; why it is invalid."""
        best = self._attempt(prepared, self._keyframe, self._T_odom_keyframe, guess)
        if not self._convinces(best, guess):
            found = [best]
            for target, T_odom_target, start, searched in self._other_starts(prepared, guess):
                T_keyframe_start = inverse(self._T_odom_keyframe) @ start
                if not any(self._leads_to(T_keyframe_start, result) for result in found):
                    found.append(self._attempt(prepared, target, T_odom_target, start))
                    best = max(found, key=lambda result: result.agreement)
                if searched and self._fits(best):
                    break
        return best, self._objection(best, elapsed_s)

    def _fits(self, result: Registration) -> bool:
        limits = self._config
        return result.fitness >= limits.good_fitness and result.agreement >= limits.min_agreement

    def _convinces(self, result: Registration, guess: Pose) -> bool:
        """Whether no other answer needs to be looked for.

        After a slow motion a good fit convinces; after a fast one it may be a wrong one nearby,
        unless the motion came as it was predicted. Then also a weak fit does, of a noisy image or
        a view that changes quickly, where what matches looks alike.
        """
        correction = inverse(guess) @ self._T_odom_keyframe @ result.T_target_source
        if not _exceeds(correction, EXPECTED_MOTION_M, EXPECTED_TURN_RAD):
            return self._fits(result) or (result.looks_alike and not self._is_too_weak(result))
        predicted = inverse(self._T_odom_last) @ guess
        return self._fits(result) and not any(
            _exceeds(motion, SAFE_MOTION_M, SAFE_TURN_RAD) for motion in (correction, predicted)
        )

    def _is_too_weak(self, result: Registration) -> bool:
        limits = self._config
        return result.fitness < limits.min_fitness or result.agreement < limits.min_agreement

    def _leads_to(self, T_keyframe_start: Pose, result: Registration) -> bool:
        """Whether a registration that starts there would only end where another one did."""
        apart = inverse(T_keyframe_start) @ result.T_target_source
        return result.fitness >= self._config.min_fitness and not _exceeds(
            apart, SAME_MOTION_M, SAME_TURN_RAD
        )

    def _other_starts(self, prepared: Any, guess: Pose) -> Iterator[tuple[Any, Pose, Pose, bool]]:
        """Target, its pose, T_odom_camera to start from, and whether that took a search.

        The most promising come first.
        """
        keyframe, previous = (
            (self._keyframe, self._T_odom_keyframe),
            (self._previous, self._T_odom_last),
        )
        for target, T_odom_target in (keyframe, previous):
            for proposed in self._registrar.propose(prepared, target):
                yield target, T_odom_target, T_odom_target @ proposed, False
        for (target, T_odom_target), around in (
            (keyframe, guess),
            (previous, guess),
            (previous, self._T_odom_last),
        ):
            try:
                found = self._registrar.search(prepared, target, inverse(T_odom_target) @ around)
            except RuntimeError as error:
                logger.debug("search failed: %s", error)
                continue
            yield target, T_odom_target, T_odom_target @ found, True

    def _attempt(
        self, prepared: Any, target: Any, T_odom_target: Pose, guess: Pose
    ) -> Registration:
        """One registration, expressed against the keyframe; fitness 0 where it fails."""
        failed = Registration(np.eye(4), np.zeros((6, 6)), 0.0, float("inf"))
        try:
            result = self._registrar.register(prepared, target, inverse(T_odom_target) @ guess)
        except RuntimeError as error:
            logger.debug("registration failed: %s", error)
            return failed
        if not np.isfinite(result.T_target_source).all():
            return failed
        to_keyframe = inverse(self._T_odom_keyframe) @ T_odom_target
        return dataclasses.replace(result, T_target_source=to_keyframe @ result.T_target_source)

    def _objection(self, result: Registration, elapsed_s: float) -> str:
        """Why a result is not to be trusted; empty when it is."""
        if result.fitness < self._config.min_fitness:
            return f"only {result.fitness:.0%} of the points match"
        if result.agreement < self._config.min_agreement:
            return f"only {result.agreement:.0%} of the points match in depth and colour"
        motion = inverse(self._T_odom_last) @ self._T_odom_keyframe @ result.T_target_source
        speed = np.linalg.norm(motion[:3, 3]) / elapsed_s
        turn = np.rad2deg(rotation_angle(motion)) / elapsed_s
        if speed > self._config.max_speed_m_s or turn > self._config.max_turn_deg_s:
            return f"impossible motion: {speed:.1f} m/s, {turn:.0f} deg/s"
        return ""

    def _is_new_keyframe(
        self, T_odom_camera: Pose, registration: Registration, valid: bool
    ) -> bool:
        if not valid:
            # A frame that fits nothing would chain an error; after two, the scene has changed.
            return self._failures >= 2
        offset = inverse(self._T_odom_keyframe) @ T_odom_camera
        moved = float(np.linalg.norm(offset[:3, 3])) > self._config.keyframe_translation_m
        turned = np.rad2deg(rotation_angle(offset)) > self._config.keyframe_rotation_deg
        return moved or turned or registration.fitness < self._config.good_fitness


def _exceeds(motion: Pose, motion_m: float, turn_rad: float) -> bool:
    return bool(np.linalg.norm(motion[:3, 3]) > motion_m or rotation_angle(motion) > turn_rad)


def _covariance(registration: Registration, valid: bool) -> NDArray[np.float64]:
    """Covariance (6, 6), translation first, of a registration."""
    if not valid:
        return np.eye(6) * UNKNOWN_VARIANCE
    information = registration.information + np.eye(6) / UNKNOWN_VARIANCE
    return np.asarray(np.linalg.inv(information), np.float64)
