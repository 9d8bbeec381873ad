from __future__ import annotations

from sensor_msgs.msg import Image

from meslam_ros.conversions import to_stamp
from meslam_ros.image_synchronizer import MAX_WAITING, ImageSynchronizer

MS = 1_000_000
PERIOD = 33 * MS


def image(stamp_ns: int) -> Image:
    message = Image()
    message.header.stamp = to_stamp(stamp_ns)
    return message


def feed(synchronizer: ImageSynchronizer, order: str, *stamps: int) -> list[int]:
    """Stamps of the pairs that come out when colour ('c') and depth ('d') come in this order."""
    pairs = []
    for kind, stamp in zip(order, stamps, strict=True):
        add = synchronizer.add_color if kind == "c" else synchronizer.add_depth
        pairs += [pair.stamp_ns for pair in add(image(stamp))]
    return pairs


def test_equal_stamps_pair_at_once_whichever_comes_first() -> None:
    synchronizer = ImageSynchronizer(0.02)
    assert feed(synchronizer, "cd", 0, 0) == [0]
    assert feed(synchronizer, "dc", PERIOD, PERIOD) == [PERIOD]
    assert not +synchronizer.dropped


def test_nearly_equal_stamps_do_not_wait_for_another_image() -> None:
    assert feed(ImageSynchronizer(0.02), "dc", 10 * MS - 3 * MS, 10 * MS) == [10 * MS]


def test_nearest_partner_wins_within_the_tolerance() -> None:
    synchronizer = ImageSynchronizer(0.02)
    assert feed(synchronizer, "dc", 100 * MS, 112 * MS) == []
    (pair,) = synchronizer.add_depth(image(114 * MS))
    assert pair.depth.header.stamp == to_stamp(114 * MS)
    assert synchronizer.dropped["depth image without partner"] == 1


def test_colour_is_paired_with_earlier_depth_when_later_depth_is_farther() -> None:
    synchronizer = ImageSynchronizer(0.02)
    assert feed(synchronizer, "dcd", 100 * MS, 110 * MS, 133 * MS) == [110 * MS]


def test_images_farther_apart_than_the_tolerance_never_pair() -> None:
    stamps = [number // 2 * PERIOD + number % 2 * 16 * MS for number in range(40)]
    assert feed(ImageSynchronizer(0.01), "cd" * 20, *stamps) == []
    assert len(feed(ImageSynchronizer(0.02), "cd" * 20, *stamps)) == 20


def test_lost_image_costs_one_pair_and_is_counted() -> None:
    synchronizer = ImageSynchronizer(0.02)
    assert feed(synchronizer, "cdccd", 0, 0, PERIOD, 2 * PERIOD, 2 * PERIOD) == [0, 2 * PERIOD]
    assert synchronizer.dropped["colour image without partner"] == 1


def test_memory_is_bounded_when_one_topic_is_silent() -> None:
    synchronizer = ImageSynchronizer(0.02)
    count = 3 * MAX_WAITING
    assert feed(synchronizer, "c" * count, *(i * PERIOD for i in range(count))) == []
    assert synchronizer.dropped["colour image without partner"] == count - MAX_WAITING


def test_repeated_and_late_images_are_dropped_not_paired_twice() -> None:
    synchronizer = ImageSynchronizer(0.02)
    start = 1_000 * MS
    assert feed(synchronizer, "cdcd", start, start, start, start) == [start]
    assert feed(synchronizer, "cd", start - PERIOD, start - PERIOD) == []
    assert synchronizer.dropped["colour image came too late"] == 2


def test_recording_that_starts_again_is_paired_again() -> None:
    synchronizer = ImageSynchronizer(0.02)
    late = 10_000 * MS
    assert feed(synchronizer, "cdcd", late, late, 0, 0) == [late, 0]


def test_images_with_wrong_stamps_do_not_fill_the_places_of_good_ones() -> None:
    synchronizer = ImageSynchronizer(0.02)
    wrong = [10**15 + number * PERIOD for number in range(2 * MAX_WAITING)]
    assert feed(synchronizer, "d" * len(wrong), *wrong) == []
    for number in range(3):
        stamp = number * PERIOD
        assert feed(synchronizer, "dc", stamp, stamp) == [stamp]
