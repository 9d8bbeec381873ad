"""Images that are missing, dark, of another size or encoding, or on the wrong topic."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from data.bag_builder import ALIGNED_DEPTH, COLOR, COLOR_INFO, BagBuilder
from faults.expectations import (
    broke_off,
    built,
    each,
    refused,
    tracked,
    walked,
)
from faults.fault import Group, faults_of
from faults.material import FRAMES, MIDDLE, WHILE, Shot


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


def _encoded(encoding: str) -> Callable[[Shot], None]:
    return lambda shot: setattr(shot, "color_encoding", encoding)


def _swapped(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.depth, "16UC1")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.color, "rgb8")


def _of_other_size(builder: BagBuilder, shot: Shot) -> None:
    builder.camera_info(COLOR_INFO, shot.stamp_ns, shot.camera)
    builder.image(COLOR, shot.stamp_ns, shot.color, "rgb8")
    builder.image(ALIGNED_DEPTH, shot.stamp_ns, shot.depth[::2, ::2], "16UC1")


_fault = faults_of(Group.INPUT)

COLOR_AND_BOTH = (
    _fault(
        "colour-and-depth-swapped",
        "the colour topic carries depth, the depth topic colour",
        "refused; the message lists the topics with their encodings",
        built(_swapped),
        refused("16UC1", "rgb8"),
    ),
    _fault(
        "sizes-differ",
        "depth images have half the size of colour, and no camera info of their own",
        "refused; the message gives both sizes and the remedy",
        built(_of_other_size),
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


FAULTS = COLOR_AND_BOTH
