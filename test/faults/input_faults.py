"""Faults of images, stamps and calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from data.bag_builder import ALIGNED_DEPTH, COLOR, COLOR_INFO, BagBuilder
from faults.bench import Bench
from faults.expectations import (
    Problem,
    broke_off,
    each,
    refused,
    run,
    tracked,
    untracked,
    walked,
)
from faults.fault import Fault, Group, Seen
from faults.material import FRAMES, Shot, frames, record, shots

MIDDLE = FRAMES // 2
WHILE = slice(8, 14)
SECOND_NS = 1_000_000_000
YEAR_NS = 365 * 86_400 * SECOND_NS


def _metres(shot: Shot) -> None:
    shot.depth = shot.depth.astype(np.float32) / 1000


def _nan(shot: Shot) -> None:
    _metres(shot)
    shot.depth[::3] = np.nan
    shot.depth[1::7] = np.inf
    shot.depth[2::11] = -1.0


def _scaled(factor: float) -> Callable[[Shot], None]:
    def scale(shot: Shot) -> None:
        shot.depth = np.rint(shot.depth * factor).astype(np.uint16)

    return scale


def _as_float_millimetres(shot: Shot) -> None:
    shot.depth = shot.depth.astype(np.float32)


def _filled(value: int) -> Callable[[Shot], None]:
    def fill(shot: Shot) -> None:
        shot.depth[:] = value

    return fill


def _half_saturated(shot: Shot) -> None:
    shot.depth[:, ::2] = 65535


def _speckled(shot: Shot) -> None:
    generator = np.random.default_rng(shot.stamp_ns % 1000)
    wrong = generator.random(shot.depth.shape) < 0.2
    shot.depth[wrong] = generator.integers(1, 65535, np.count_nonzero(wrong))


def _frozen_depth(taken: list[Shot]) -> None:
    for shot in taken[WHILE]:
        shot.depth = taken[WHILE.start].depth


def _frozen_color(taken: list[Shot]) -> None:
    for shot in taken[WHILE]:
        shot.color = taken[WHILE.start].color


def _covered(shot: Shot) -> None:
    shot.color[:] = 3
    shot.depth[:] = 0


def _without(part: str) -> Callable[[list[Shot]], None]:
    return each(lambda shot: setattr(shot, part, None), WHILE.start, WHILE.stop)


def _exposed(factor: float) -> Callable[[Shot], None]:
    def expose(shot: Shot) -> None:
        shot.color = np.clip(shot.color * factor, 0, 255).astype(np.uint8)

    return expose


def _flicker(taken: list[Shot]) -> None:
    for number, shot in enumerate(taken):
        _exposed(0.5 if number % 2 else 1.4)(shot)


def _black(shot: Shot) -> None:
    shot.color[:] = 0


def _half_size(shot: Shot) -> None:
    shot.color = np.ascontiguousarray(shot.color[::2, ::2])
    shot.depth = np.ascontiguousarray(shot.depth[::2, ::2])


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


def _with_camera(**values: float) -> Callable[[Shot], None]:
    def change(shot: Shot) -> None:
        shot.camera = replace(shot.camera, **values)

    return change


def _encoded(encoding: str) -> Callable[[Shot], None]:
    return lambda shot: setattr(shot, "color_encoding", encoding)


def _built(build: Callable[[BagBuilder, Shot], None]) -> Callable[[Bench], Seen]:
    """The walk with other messages than a camera's."""

    def inject(bench: Bench) -> Seen:
        builder = BagBuilder()
        for shot in shots():
            build(builder, shot)
        return run(bench, builder.write(bench.folder))

    return inject


def _swapped(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.depth, "16UC1")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.color, "rgb8")


def _of_other_size(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth[::2, ::2], "16UC1")


def _color_alone(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")


def _depth_alone(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth, "16UC1")


def _without_info(builder: BagBuilder, shot: Shot) -> None:
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth, "16UC1")


def _with_matrix(k: np.ndarray) -> Callable[[BagBuilder, Shot], None]:
    def build(builder: BagBuilder, shot: Shot) -> None:
        _without_info(builder, shot)
        builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera, k=k)

    return build


def _changed_matrix(bench: Bench) -> Seen:
    taken = shots()
    each(_with_camera(fx=1.3 * frames()[0].camera.fx), MIDDLE)(taken)
    return run(bench, record(taken, bench.folder))


def _two_clocks(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    later = shot.stamp_ns + 3600 * SECOND_NS
    builder.image(ALIGNED_DEPTH, later, shot.depth, "16UC1", recorded_ns=shot.stamp_ns)


def _fault(
    name: str,
    injected: str,
    expected: str,
    inject: Callable[[Bench], Seen],
    problem: Problem,
    quick: bool = False,
) -> Fault:
    return Fault(name, Group.INPUT, injected, expected, inject, problem, quick=quick)


DEPTH = (
    _fault(
        "depth-nan",
        "half of all depth pixels are NaN, infinite or negative",
        "they are holes; every frame is tracked",
        walked(each(_nan)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-all-zero",
        "every depth image is empty",
        "status 3, no map; the message says that the depth image is empty",
        walked(each(_filled(0))),
        untracked("the depth image is empty"),
    ),
    _fault(
        "depth-saturated",
        "every depth pixel has the largest value",
        "status 3, no map; the message gives the value and says that the camera is stuck",
        walked(each(_filled(65535))),
        untracked("65.5", "stuck"),
    ),
    _fault(
        "depth-half-saturated",
        "every second column of depth has the largest value",
        "these pixels are out of range; every frame is tracked",
        walked(each(_half_saturated)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-all-equal",
        "six depth images in the middle have the same value everywhere",
        "these frames are DEGRADED and train nothing; the others are tracked",
        walked(each(_filled(1500), WHILE.start, WHILE.stop)),
        tracked(FRAMES - 6),
    ),
    _fault(
        "depth-all-equal-from-the-start",
        "all depth images have the same value everywhere",
        "status 3, no map; the message says that the camera is stuck",
        walked(each(_filled(1500))),
        untracked("1.5 m", "stuck"),
    ),
    _fault(
        "depth-frozen",
        "the driver repeats one depth image for six frames while colour goes on",
        "no pose that is said to be good is off by more than 5 cm; the rest is tracked",
        walked(_frozen_depth),
        tracked(FRAMES - 6, within_m=0.05),
    ),
    _fault(
        "depth-speckled",
        "a fifth of all depth pixels have random values",
        "every frame is tracked",
        walked(each(_speckled)),
        tracked(FRAMES),
    ),
    _fault(
        "depth-millimetres-as-metres",
        "32FC1 images hold millimetres",
        "status 3, no map; the message names the unit and the remedy",
        walked(each(_as_float_millimetres)),
        untracked("millimetres taken as metres", "REP-118"),
        quick=True,
    ),
    _fault(
        "depth-metres-as-millimetres",
        "16UC1 images hold whole metres",
        "status 3, no map; the message names the remedy",
        walked(each(_scaled(0.001))),
        untracked("REP-118", "millimetres"),
    ),
    _fault(
        "depth-in-tenths-of-millimetres",
        "16UC1 images hold tenths of millimetres, as some cameras send",
        "status 3, no map; the message doubts the unit and names the remedy",
        walked(each(_scaled(10))),
        untracked("is that its unit", "REP-118"),
    ),
    _fault(
        "depth-five-times-too-small",
        "16UC1 images hold a fifth of the depth: a doll's house",
        "it is tracked, for scale cannot be seen; a warning doubts the unit, names the remedy",
        walked(each(_scaled(0.2))),
        tracked(FRAMES, "is that its unit", "depth_scale_m", within_m=1.0),
    ),
)
COLOR_AND_BOTH = (
    _fault(
        "colour-and-depth-swapped",
        "the colour topic carries depth, the depth topic colour",
        "refused; the message lists the topics with their encodings",
        _built(_swapped),
        refused("16UC1", "rgb8"),
    ),
    _fault(
        "sizes-differ",
        "depth images have half the size of colour, and no camera info of their own",
        "refused; the message gives both sizes and the remedy",
        _built(_of_other_size),
        refused("80x60", "160x120", "camera_info"),
    ),
    _fault(
        "colour-missing-for-a-while",
        "six colour images are not there",
        "the rest is tracked",
        walked(_without("color")),
        tracked(FRAMES - 6),
    ),
    _fault(
        "depth-missing-for-a-while",
        "six depth images are not there",
        "the rest is tracked; a warning counts the colour images without depth",
        walked(_without("depth")),
        tracked(FRAMES - 6, "6 colour images without"),
    ),
    _fault(
        "camera-covered",
        "a hand before the lens for six frames",
        "nothing is trained meanwhile; the rest is tracked",
        walked(each(_covered, WHILE.start, WHILE.stop)),
        tracked(FRAMES - 6),
    ),
    _fault(
        "colour-frozen",
        "the driver repeats one colour image for six frames while depth goes on",
        "no pose that is said to be good is off by more than 5 cm; the rest is tracked",
        walked(_frozen_color),
        tracked(FRAMES - 6, within_m=0.05),
    ),
    _fault(
        "exposure-jump",
        "from one frame to the next the images have a third of the brightness",
        "every frame is tracked",
        walked(each(_exposed(0.33), MIDDLE)),
        tracked(FRAMES),
    ),
    _fault(
        "exposure-flicker",
        "every other image is overexposed, the ones between are dark",
        "every frame is tracked",
        walked(_flicker),
        tracked(FRAMES),
    ),
    _fault(
        "colour-black",
        "every colour image is black: a lens cap, or no light",
        "geometry alone tracks; no pose that is said to be good is off by more than 5 cm",
        walked(each(_black)),
        tracked(1, within_m=0.05),
    ),
    _fault(
        "size-changes",
        "from the middle on the images have half the size",
        "status 2; the results of the frames before are there, the message names the frame",
        walked(each(_half_size, MIDDLE)),
        broke_off(MIDDLE, f"frame {MIDDLE}"),
    ),
    _fault(
        "encoding-changes",
        "from the middle on the colour images have an unknown encoding",
        "status 2; the results of the frames before are there, the encoding is named",
        walked(each(_encoded("bayer_rggb16"), MIDDLE)),
        broke_off(MIDDLE, "bayer_rggb16"),
    ),
    _fault(
        "encoding-unknown",
        "all colour images have an encoding that is not colour",
        "refused; the message lists the topics with their encodings",
        walked(each(_encoded("bayer_rggb16"))),
        refused("bayer_rggb16"),
    ),
)
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
        lambda seen: _every_frame(seen),
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
        quick=True,
    ),
)
CALIBRATION = (
    _fault(
        "camera-info-changes",
        "in the middle the camera info's focal length grows by a third",
        "a warning says when it changed and that the first one is used",
        _changed_matrix,
        tracked(1, "camera info", "changes", within_m=0.05),
    ),
    _fault(
        "intrinsics-wrong",
        "the camera info's focal lengths are a fifth too large",
        "it runs; no pose said to be good is off by more than 10 cm",
        walked(each(_with_camera(fx=156.0, fy=156.0))),
        tracked(1, within_m=0.10),
    ),
    _fault(
        "intrinsics-zero",
        "the camera info's matrix is zero: an uncalibrated camera",
        "refused; the message says how to give intrinsics",
        _built(_with_matrix(np.zeros((3, 3)))),
        refused("no intrinsics", "--camera"),
    ),
    _fault(
        "intrinsics-nan",
        "the camera info's matrix holds NaN",
        "refused; the message says how to give intrinsics",
        _built(_with_matrix(np.full((3, 3), np.nan))),
        refused("no intrinsics", "--camera"),
    ),
    _fault(
        "camera-info-missing",
        "there is no camera info",
        "refused; the message says how to give intrinsics",
        _built(_without_info),
        refused("no camera info", "--camera"),
    ),
    _fault(
        "depth-topic-missing",
        "the recording has colour alone",
        "refused; the message lists the image topics",
        _built(_color_alone),
        refused("no depth images", COLOR),
    ),
    _fault(
        "colour-topic-missing",
        "the recording has depth alone",
        "refused; the message lists the image topics",
        _built(_depth_alone),
        refused("no colour images", ALIGNED_DEPTH),
    ),
)


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


FAULTS = DEPTH + COLOR_AND_BOTH + STAMPS + CALIBRATION
