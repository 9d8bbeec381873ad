"""Frames at the recording's pace."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame
from meslam_core.pacing import PacedFrames

CAMERA = PinholeCamera(2, 1, 1.0, 1.0, 0.5, 0.0)


class Clock:
    """Time that passes only when somebody waits or works."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def read(self) -> float:
        return self.now_s

    def wait(self, seconds: float) -> None:
        assert seconds > 0
        self.now_s += seconds


def frames(count: int, period_s: float = 0.1) -> list[RgbdFrame]:
    color, depth = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2), np.float32)
    start = 1_700_000_000_000_000_000
    return [
        RgbdFrame(start + round(n * period_s * 1e9), color, depth, CAMERA) for n in range(count)
    ]


def play(images: list[RgbdFrame], work_s: float) -> tuple[list[int], list[float], int]:
    """Numbers of the frames that were worked on, when they were begun, how many were skipped."""
    clock = Clock()
    paced = PacedFrames(images, clock.read, clock.wait)
    numbers, times = [], []
    for frame in paced:
        numbers.append(images.index(frame))
        times.append(clock.now_s - 100.0)
        clock.now_s += work_s
    return numbers, times, paced.skipped


def test_a_fast_worker_gets_every_frame_when_it_is_due():
    numbers, times, skipped = play(frames(8), work_s=0.02)
    assert numbers == list(range(8))
    assert skipped == 0
    assert times == pytest.approx([0.1 * n for n in range(8)])


def test_a_slow_worker_gets_the_newest_frame_and_the_rest_is_counted():
    numbers, times, skipped = play(frames(10), work_s=0.25)
    assert numbers == [0, 2, 5, 7, 9]
    assert skipped == 5
    assert times == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])


def test_no_frame_comes_before_its_time():
    images = frames(20)
    numbers, times, _ = play(images, work_s=0.13)
    for number, time_s in zip(numbers, times, strict=True):
        assert time_s >= 0.1 * number - 1e-6


def test_reading_a_frame_makes_the_one_before_no_later():
    clock = Clock()

    def read_slowly():
        for frame in frames(6):
            clock.now_s += 0.03
            yield frame

    times = []
    for _ in PacedFrames(read_slowly(), clock.read, clock.wait):
        times.append(clock.now_s)
        clock.now_s += 0.05
    assert np.diff(times) == pytest.approx([0.1] * 5)


def test_no_frames_are_no_frames():
    assert play([], work_s=0.1) == ([], [], 0)


def test_an_error_of_the_recording_comes_after_the_frames_before_it():
    def broken():
        yield from frames(2)
        raise OSError("damaged")

    clock = Clock()
    paced = iter(PacedFrames(broken(), clock.read, clock.wait))
    stamps = [next(paced).stamp_ns, next(paced).stamp_ns]
    assert stamps == [frame.stamp_ns for frame in frames(2)]
    with pytest.raises(OSError, match="damaged"):
        next(paced)
