"""Odometry in its own thread gives what it gives in the caller's."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from meslam_core.errors import RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import Odometry, OdometryEstimate, make_odometry
from meslam_core.odometry_worker import OdometryWorker

WAIT_S = 10.0


class Still:
    """An odometry that has nothing to do."""

    def process(self, frame: RgbdFrame) -> OdometryEstimate:
        return OdometryEstimate(frame.stamp_ns, np.eye(4), np.eye(6), 1.0, 0.0, valid=True)


class Counted:
    """Frames that tell how many were taken, and raise an error after the last one."""

    def __init__(self, frames: list[RgbdFrame], error: Exception | None = None) -> None:
        self.taken = 0
        self._frames = frames
        self._error = error

    def __iter__(self) -> Iterator[RgbdFrame]:
        for frame in self._frames:
            self.taken += 1
            yield frame
        if self._error is not None:
            raise self._error


def make(config) -> Odometry:
    return make_odometry(config.odometry, config.sensor)


def odometry_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name == "meslam-odometry"]


def stamps_until_the_end(worker: OdometryWorker, stamps: list[int], ready: int = 0) -> None:
    """Appends the frames' stamps; after the first it waits until so many items are ready."""
    for timed in worker:
        if not stamps:
            wait_until(lambda: worker._ready.qsize() >= ready)
        stamps.append(timed.frame.stamp_ns)


def wait_until(condition) -> None:
    ends = time.monotonic() + WAIT_S
    while not condition() and time.monotonic() < ends:
        time.sleep(0.001)
    assert condition()


def test_frames_come_in_order_with_the_estimates_of_a_serial_run(quick_config, room_frames):
    frames = room_frames[:6]
    serial = make(quick_config)
    expected = [serial.process(frame) for frame in frames]
    timed = list(OdometryWorker(frames, make(quick_config), ahead=2))
    assert all(ready.frame is frame for ready, frame in zip(timed, frames, strict=True))
    for ready, estimate in zip(timed, expected, strict=True):
        assert ready.odometry.stamp_ns == estimate.stamp_ns
        assert ready.odometry.valid == estimate.valid
        assert ready.odometry.fitness == estimate.fitness
        np.testing.assert_array_equal(ready.odometry.T_odom_camera, estimate.T_odom_camera)
        np.testing.assert_array_equal(ready.odometry.covariance, estimate.covariance)
        assert ready.odometry_ms > 0.0
        assert ready.reading_ms >= 0.0
    assert not odometry_threads()


def test_no_frames_end_at_once():
    assert list(OdometryWorker([], Still(), ahead=1)) == []


def test_an_error_while_reading_comes_after_the_frames_before_it(room_frames):
    frames = Counted(room_frames[:3], RecordingError("the recording ends early"))
    worker = OdometryWorker(frames, Still(), ahead=8)
    seen: list[int] = []
    with pytest.raises(RecordingError, match="ends early"):
        # The error waits behind two frames, and still they come first.
        stamps_until_the_end(worker, seen, ready=3)
    assert seen == [frame.stamp_ns for frame in room_frames[:3]]
    assert not odometry_threads()


def test_an_error_of_odometry_is_raised_too(room_frames):
    class Failing(Still):
        def process(self, frame: RgbdFrame) -> OdometryEstimate:
            if frame.stamp_ns == room_frames[2].stamp_ns:
                raise ValueError("cannot register")
            return super().process(frame)

    seen: list[int] = []
    with pytest.raises(ValueError, match="cannot register"):
        stamps_until_the_end(OdometryWorker(room_frames, Failing(), ahead=2), seen)
    assert seen == [frame.stamp_ns for frame in room_frames[:2]]


def test_leaving_the_loop_early_ends_the_thread(room_frames):
    frames = Counted(room_frames)
    ready = iter(OdometryWorker(frames, Still(), ahead=1))
    next(ready)
    assert odometry_threads()
    ready.close()
    assert not odometry_threads()
    assert frames.taken < len(room_frames)


@pytest.mark.parametrize("ahead", [1, 3])
def test_no_more_frames_are_taken_ahead_than_asked_for(room_frames, ahead):
    frames = Counted(room_frames)
    worker = OdometryWorker(frames, Still(), ahead)
    assert not worker.waiting
    for number, _ in enumerate(worker, start=1):
        # Those handed over, those that wait, and the one that has no room to wait in.
        limit = min(number + ahead + 1, len(room_frames))
        wait_until(lambda limit=limit: frames.taken >= limit)
        if number < 3:
            time.sleep(0.02)
        assert frames.taken <= limit
        assert number == len(room_frames) or worker.waiting
        if number == 6:
            break
