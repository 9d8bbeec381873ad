from __future__ import annotations

import numpy as np
import pytest

from meslam_ros.stamp_guard import StampGuard, Verdict

GOES_ON, ANEW = Verdict.GOES_ON, Verdict.BEGINS_ANEW
JUMPS, OLD = Verdict.JUMPS, Verdict.IS_OLD
WELL = [GOES_ON, GOES_ON]


@pytest.mark.parametrize(
    ("stamps_s", "verdicts"),
    [
        pytest.param([5.0, 5.1, 5.2], [*WELL, GOES_ON], id="a camera"),
        pytest.param([5.0, 5.1, 0.0, 5.2], [*WELL, JUMPS, GOES_ON], id="zero"),
        pytest.param([5.0, 5.1, 2e9, 5.2], [*WELL, JUMPS, GOES_ON], id="far ahead"),
        pytest.param([5.0, 5.1, 9.0, 9.1], [*WELL, JUMPS, GOES_ON], id="a pause"),
        pytest.param(
            [5.0, 5.1, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6],
            [*WELL, JUMPS, JUMPS, JUMPS, JUMPS, JUMPS, ANEW, GOES_ON],
            id="starts again",
        ),
        pytest.param([0.0, 2.0, 4.0, 6.5], [*WELL, GOES_ON, GOES_ON], id="a frame in two seconds"),
        pytest.param([5.0, 5.1, 5.1, 5.05, 5.2], [*WELL, OLD, OLD, GOES_ON], id="old"),
    ],
)
def test_a_jump_counts_when_the_next_pairs_follow_it(stamps_s, verdicts) -> None:
    guard = StampGuard()
    assert [guard.judge(round(stamp * 1e9)) for stamp in stamps_s] == verdicts


def test_frames_in_random_order_do_not_begin_anew() -> None:
    for seed in range(20):
        guard = StampGuard()
        stamps = np.random.default_rng(seed).permutation(60) * 66_666_667
        verdicts = [guard.judge(100_000_000_000 + int(stamp)) for stamp in stamps]
        assert ANEW not in verdicts, seed
