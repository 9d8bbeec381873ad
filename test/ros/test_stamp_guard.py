from __future__ import annotations

import pytest

from meslam_ros.stamp_guard import StampGuard, Verdict

GOES_ON, ANEW = Verdict.GOES_ON, Verdict.BEGINS_ANEW
JUMPS, OLD = Verdict.JUMPS, Verdict.IS_OLD


@pytest.mark.parametrize(
    ("stamps_s", "verdicts"),
    [
        pytest.param([5.0, 5.1, 5.2], [GOES_ON] * 3, id="a camera"),
        pytest.param([5.0, 5.1, 0.0, 5.2], [GOES_ON, GOES_ON, JUMPS, GOES_ON], id="zero"),
        pytest.param([5.0, 5.1, 2e9, 5.2], [GOES_ON, GOES_ON, JUMPS, GOES_ON], id="far ahead"),
        pytest.param([5.0, 5.1, 1.0, 1.1], [GOES_ON, GOES_ON, JUMPS, ANEW], id="starts again"),
        pytest.param([5.0, 5.1, 9.0, 9.1], [GOES_ON, GOES_ON, JUMPS, GOES_ON], id="a pause"),
        pytest.param([0.0, 2.0, 4.0, 6.5], [GOES_ON] * 4, id="one frame in two seconds"),
        pytest.param([5.0, 5.1, 5.1, 5.05, 5.2], [GOES_ON, GOES_ON, OLD, OLD, GOES_ON], id="old"),
        pytest.param(
            [50.0, 50.1, 9.0, 30.0, 3.0, 70.0, 50.2],
            [GOES_ON, GOES_ON, JUMPS, JUMPS, JUMPS, JUMPS, GOES_ON],
            id="in random order",
        ),
    ],
)
def test_a_jump_counts_when_the_next_pair_follows_it(stamps_s, verdicts) -> None:
    guard = StampGuard()
    assert [guard.judge(round(stamp * 1e9)) for stamp in stamps_s] == verdicts
