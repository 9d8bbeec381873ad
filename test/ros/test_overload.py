from __future__ import annotations

from meslam_ros.overload import WINDOW_S, Overload


def test_overload_is_told_while_too_many_pairs_are_skipped() -> None:
    now = [0.0]
    load = Overload(lambda: 0.2, lambda: now[0])
    told = []
    came = skipped = 0
    for second in range(20):
        now[0] = float(second)
        slow = 5 <= second < 10
        came, skipped = came + 15, skipped + (6 if slow else 0)
        told.append(bool(load.count(came, skipped)))
    assert told[:6] == [False] * 6
    assert all(told[8:12])
    assert told[round(10 + WINDOW_S) :] == [False] * (10 - round(WINDOW_S))


def test_a_share_of_one_never_counts_as_overload() -> None:
    load = Overload(lambda: 1.0, lambda: 0.0)
    assert load.count(100, 100) == ""


def test_the_reason_has_the_figures() -> None:
    now = [0.0]
    load = Overload(lambda: 0.2, lambda: now[0])
    now[0] = 1.0
    assert "12 of the last 60 image pairs" in load.count(60, 12)
