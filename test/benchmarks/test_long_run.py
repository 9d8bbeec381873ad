"""The benchmark of a long run: the rounds, and what its limits are."""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import islice

import long_run
import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path

MINUTES = np.arange(0.0, 60.1, 0.5)


def test_rounds_follow_each_other_with_the_recordings_pauses():
    images = [frame_at(pose, number) for number, pose in enumerate(path(3))]
    recording = MemoryRecording(images)
    period_ns = int(recording.stamps_ns[1] - recording.stamps_ns[0])
    driven = list(islice(long_run.rounds(recording, 100.0), 8))
    assert [frame.color is images[n % 3].color for n, frame in enumerate(driven)] == [True] * 8
    assert np.diff([frame.stamp_ns for frame in driven]).tolist() == [period_ns] * 7
    assert driven[0].stamp_ns == recording.stamps_ns[0]
    seconds = 4.5 * period_ns * 1e-9
    assert len(list(long_run.rounds(recording, seconds))) == 5


def sample(minute: float) -> long_run.Sample:
    """Of a run that grows for five minutes, and then no more."""
    rss_mb = 400.0 + 20.0 * min(minute, 5.0)
    told = long_run.Told(60.0 * minute, int(600 * minute), 300, 4, 0, 0, 10.0, 20.0, 30.0, 40.0, 0)
    return long_run.Sample(told, minute, rss_mb, rss_mb, 7, 12, 50.0)


def test_a_run_that_does_not_grow_keeps_all_limits():
    found = long_run.verdict([sample(minute) for minute in MINUTES])
    assert found["settled_peak_mb"] == pytest.approx(500.0)
    assert found["growth"] == 0.0
    assert all(found["kept"].values())
    assert "All limits kept" in long_run.sentence(found)


@pytest.mark.parametrize(
    ("limit", "changed"),
    [("memory", {"peak_mb": 551.0}), ("threads", {"threads": 8}), ("files", {"files": 13})],
)
def test_each_growth_exceeds_its_limit(limit, changed):
    samples = [sample(minute) for minute in MINUTES]
    late = [replace(each, **changed) for each in samples[-len(samples) // 4 :]]
    found = long_run.verdict([*samples[: -len(late)], *late])
    assert [name for name, kept in found["kept"].items() if not kept] == [limit]
    assert f"Exceeded: {limit}." in long_run.sentence(found)


def test_a_file_that_is_open_for_a_moment_is_no_growth():
    samples = [sample(minute) for minute in MINUTES]
    found = long_run.verdict([*samples[:-1], replace(samples[-1], files=13)])
    assert all(found["kept"].values())


def test_tracking_that_becomes_slower_exceeds_its_limit():
    samples = [sample(minute) for minute in MINUTES]
    late = [replace(s, told=replace(s.told, tracking_ms=13.0)) for s in samples[-40:]]
    found = long_run.verdict([*samples[:-40], *late])
    assert [name for name, kept in found["kept"].items() if not kept] == ["latency"]


def test_a_process_is_looked_at_from_outside(tmp_path):
    before = long_run.looked_at(os.getpid())
    with (tmp_path / "scratch").open("wb") as file:
        file.write(bytes(3_000_000))
        file.flush()
        (tmp_path / "scratch").unlink()
        threads, files, scratch_mb = long_run.looked_at(os.getpid())
    assert files == before[1] + 1
    assert scratch_mb - before[2] == pytest.approx(3.0, abs=0.1)
    assert threads == before[0]
