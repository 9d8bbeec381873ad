"""The benchmark of memory: the loop, and what is read from the curve."""

from __future__ import annotations

import subprocess
import sys

import memory
import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path

from meslam_core.recordings.recording import Recording

SECOND_NS = 1_000_000_000


def test_the_loop_goes_forth_and_back_with_the_recordings_pauses():
    stamps_ns = np.array([5, 6, 8, 9]) * SECOND_NS
    numbers, looped_ns = memory.loop(stamps_ns, 11.0)
    assert numbers.tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert (looped_ns / SECOND_NS).tolist() == [5, 6, 8, 9, 10, 12, 13, 14, 16]


def test_the_looped_recording_streams_its_frames():
    images = [frame_at(pose, number) for number, pose in enumerate(path(3))]
    looped = memory.LoopedRecording(MemoryRecording(images), 0.5)
    assert isinstance(looped, Recording)
    frames = list(looped.frames())
    assert len(frames) == len(looped)
    assert [frame.stamp_ns for frame in frames] == looped.stamps_ns.tolist()
    assert np.all(np.diff(looped.stamps_ns) > 0)
    assert frames[3].color is images[1].color
    assert [f.stamp_ns for f in looped.frames(1, 6, 2)] == looped.stamps_ns[1:6:2].tolist()


def sample(sensor_s: float, rss_mb: float, peak_mb: float, stage: str = "frames") -> memory.Sample:
    return memory.Sample(stage, sensor_s, sensor_s, int(15 * sensor_s), 3, rss_mb, peak_mb)


def test_growth_is_the_peak_over_that_after_a_minute():
    curve = [sample(s, 400 + s / 10, 400 + s / 10) for s in range(0, 601, 20)]
    found = memory.summary([*curve, sample(600, 450, 485, "done")])
    assert found["reference_peak_mb"] == pytest.approx(406)
    assert found["peak_mb"] == 485
    assert found["growth"] == pytest.approx(485 / 406 - 1)
    assert found["growth_kb_a_frame"] == pytest.approx(100 / 15, rel=1e-3)


def test_a_peak_beyond_the_end_is_refused():
    with pytest.raises(ValueError, match="ended before 60 s"):
        memory.peak_after([sample(10, 1, 1)], 60.0)


def test_the_largest_memory_of_a_process_is_remembered():
    code = "a = bytearray(200_000_000); print('full', flush=True); del a; print('', flush=True); "
    code += "import sys; sys.stdin.read()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.readline()
        now_mb, peak_mb = memory.memory_mb(process.pid)
        process.stdin.close()
    assert peak_mb > 200
    assert now_mb < peak_mb - 150
