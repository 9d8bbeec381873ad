"""Stamps and orders of images that no camera should send."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from data.bag_builder import ALIGNED_DEPTH, COLOR, COLOR_INFO, BagBuilder
from faults.bench import Bench
from faults.expectations import (
    each,
    refused,
    run,
    tracked,
    walked,
)
from faults.fault import Group, Seen, faults_of
from faults.material import FRAMES, MIDDLE, Shot, shots

SECOND_NS = 1_000_000_000

YEAR_NS = 365 * 86_400 * SECOND_NS


def _all_at_once(taken: list[Shot]) -> None:
    for shot in taken:
        shot.stamp_ns = taken[0].stamp_ns


def _in_pairs(taken: list[Shot]) -> None:
    for first, second in zip(taken[::2], taken[1::2], strict=True):
        second.recorded_ns = second.stamp_ns
        second.stamp_ns = first.stamp_ns


def _moved(by_ns: int, start: int, stop: int | None) -> Callable[[list[Shot]], None]:
    def move(shot: Shot) -> None:
        shot.recorded_ns = shot.stamp_ns
        shot.stamp_ns += by_ns

    return each(move, start, stop)


def _without_stamps(shot: Shot) -> None:
    shot.recorded_ns, shot.stamp_ns = shot.stamp_ns, 0


def _bursts(taken: list[Shot]) -> None:
    for number, shot in enumerate(taken):
        shot.recorded_ns = taken[min(number // 8 * 8 + 7, FRAMES - 1)].stamp_ns + number


def _shuffled(taken: list[Shot]) -> None:
    order = np.random.default_rng(1).permutation(FRAMES)
    for place, number in enumerate(order):
        taken[number].recorded_ns = taken[place].stamp_ns


def _built(build: Callable[[BagBuilder, Shot], None]) -> Callable[[Bench], Seen]:
    """The walk with other messages than a camera's."""

    def inject(bench: Bench) -> Seen:
        builder = BagBuilder()
        for shot in shots():
            build(builder, shot)
        return run(bench, builder.write(bench.folder))

    return inject


def _two_clocks(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    later = shot.stamp_ns + 3600 * SECOND_NS
    builder.image(ALIGNED_DEPTH, later, shot.depth, "16UC1", recorded_ns=shot.stamp_ns)


def _one_frame(seen: Seen, word: str) -> str:
    """A single frame is tracked; it is too little to be compared with the truth."""
    (ended,) = seen.facts["ended"]
    if ended.unexplained:
        return str(ended.unexplained)
    if seen.facts["report"].get("frames_tracked") != 1:
        return "not one frame tracked"
    return "" if word in ended.stderr else f"not told: {word}"


def _every_frame(seen: Seen) -> str:
    """As `tracked`, where the truth has other stamps."""
    if told := seen.facts["ended"][0].unexplained:
        return str(told)
    return "" if seen.facts["report"].get("frames_tracked") == FRAMES else "not every frame tracked"


_fault = faults_of(Group.INPUT)

STAMPS = (
    _fault(
        "stamps-all-equal",
        "all images have one stamp",
        "one frame is left; a warning counts the repeated ones",
        walked(_all_at_once),
        lambda seen: (
            tracked(1, "repeated stamp")(seen)
            if seen.facts["report"].get("ate_online_rmse_m") is not None
            else _one_frame(seen, "repeated stamp")
        ),
    ),
    _fault(
        "stamps-equal-in-pairs",
        "every second frame has the stamp of the one before",
        "it is skipped with a warning; the others are tracked",
        walked(_in_pairs),
        tracked(MIDDLE, "repeated stamp"),
    ),
    _fault(
        "stamps-backwards",
        "in the middle the clock is set back by ten seconds",
        "frames are brought into order with a warning; no pose said to be good is off by 5 cm",
        walked(_moved(-10 * SECOND_NS, MIDDLE, None)),
        tracked(MIDDLE, "out of order", within_m=0.05),
    ),
    _fault(
        "stamps-far-in-the-future",
        "two frames have stamps ten years ahead",
        "the others are tracked; no pose said to be good is off by 5 cm",
        walked(_moved(10 * YEAR_NS, MIDDLE, MIDDLE + 2)),
        tracked(FRAMES - 2, within_m=0.05),
    ),
    _fault(
        "stamps-missing",
        "the driver has no clock: all stamps are zero",
        "the times of recording are taken; every frame is tracked",
        walked(each(_without_stamps)),
        _every_frame,
    ),
    _fault(
        "stamps-of-two-clocks",
        "depth is stamped an hour later than colour",
        "refused; the message asks for one clock",
        _built(_two_clocks),
        refused("one clock"),
    ),
    _fault(
        "bursts",
        "images arrive eight at a time",
        "their stamps count; every frame is tracked",
        walked(_bursts),
        tracked(FRAMES),
    ),
    _fault(
        "gap",
        "seven frames in a row are lost: 14 cm and 7 degrees at once",
        "the rest is tracked",
        walked(lambda taken: taken[:8] + taken[15:]),
        tracked(FRAMES - 7),
    ),
    _fault(
        "random-order",
        "the frames arrive in random order",
        "they are sorted with a warning; every frame is tracked",
        walked(_shuffled),
        tracked(FRAMES, "out of order"),
    ),
)


FAULTS = STAMPS
