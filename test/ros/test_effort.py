from __future__ import annotations

from meslam_ros.effort import LEAST, MappingEffort


def test_computer_that_keeps_up_maps_fully() -> None:
    effort = MappingEffort()
    assert {effort.update(waiting) for waiting in (0, 1) * 20} == {1.0}


def test_effort_falls_while_pairs_queue_up_and_recovers_afterwards() -> None:
    effort = MappingEffort()
    falling = [effort.update(10) for _ in range(30)]
    assert falling == sorted(falling, reverse=True)
    assert falling[-1] == LEAST
    rising = [effort.update(0) for _ in range(100)]
    assert rising == sorted(rising)
    assert rising[-1] == 1.0
