"""The benchmark of an overloaded computer: which frames are skipped, and what is counted."""

from __future__ import annotations

import numpy as np
import overload
import pytest

STAMPS_S = 100.0 + np.arange(300) / 15.0


@pytest.mark.parametrize(("schedule", "frames_apart"), [("0.33 s apart", 5), ("0.6 s apart", 9)])
def test_frames_are_so_far_apart_after_the_first_seconds(schedule, frames_apart):
    chosen = overload.processed(STAMPS_S, schedule, seed=0)
    assert chosen[:45] == list(range(45))
    assert set(np.diff(chosen[44:])) == {frames_apart}
    assert chosen[-1] >= 300 - frames_apart


def test_stalls_come_now_and_then_and_are_the_same_for_a_seed():
    chosen = overload.processed(STAMPS_S, overload.STALLS, seed=1)
    assert chosen == overload.processed(STAMPS_S, overload.STALLS, seed=1)
    assert chosen != overload.processed(STAMPS_S, overload.STALLS, seed=2)
    pauses = np.diff(chosen) / 15.0
    stalls = pauses[pauses > 0.1]
    assert 3 <= len(stalls) <= 8
    assert np.all((stalls > 0.99) & (stalls < 2.14))
    assert np.all(pauses[pauses < 0.1] == pytest.approx(1 / 15.0))


def test_only_poses_that_are_called_good_count_as_wrong():
    frames = [
        overload.Frame(0, "OK", 0.3, 10.0, ""),
        overload.Frame(1, "OK", 0.3, 1.0, ""),
        overload.Frame(2, "DEGRADED", 0.5, 1.0, "adrift"),
        overload.Frame(3, "RELOCALISING", 5.0, 1.0, ""),
    ]
    found = overload.summary(frames)
    assert found["wrong"] == 1
    assert (found["ok"], found["degraded"], found["lost"]) == (0.5, 0.25, 0.25)
    assert (found["worst_ok_m"], found["worst_degraded_m"]) == (0.3, 0.5)
