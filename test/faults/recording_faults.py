"""Recordings that are cut off, empty, in the wrong place, or something else."""

from __future__ import annotations

import os
import random
import shutil
import subprocess

from data.bag_builder import BagBuilder
from faults import material
from faults.bench import Bench, wait_for
from faults.expectations import (
    BAD_INPUT,
    command,
    ended,
    refused,
    run,
    tracked,
)
from faults.fault import Group, Seen, faults_of


def _broken_off(bench: Bench) -> Seen:
    recording = bench.copy(material.bag(bench))
    data = recording.read_bytes()
    recording.write_bytes(data[: len(data) * 6 // 10])
    return run(bench, recording)


def _flipped_in_the_middle(bench: Bench) -> Seen:
    """Bits of an image's row: the picture is wrong, the file is not."""
    recording = bench.copy(material.bag(bench, "db3"))
    data = bytearray(recording.read_bytes())
    generator = random.Random(3)
    for _ in range(200):
        data[generator.randrange(len(data) // 2, len(data))] ^= 255
    recording.write_bytes(data)
    return run(bench, recording)


def _empty_bag(bench: Bench) -> Seen:
    builder = BagBuilder()
    return run(bench, builder.write(bench.folder))


def _one_frame(bench: Bench) -> Seen:
    return run(bench, material.record(material.shots()[:1], bench.folder))


def _empty_file(bench: Bench) -> Seen:
    (bench.folder / "nothing.mcap").touch()
    return run(bench, bench.folder / "nothing.mcap")


def _pipe(bench: Bench) -> Seen:
    os.mkfifo(bench.folder / "pipe.mcap")
    return run(bench, bench.folder / "pipe.mcap")


def _directory_called_bag(bench: Bench) -> Seen:
    (bench.folder / "walk.mcap").mkdir()
    return run(bench, bench.folder / "walk.mcap")


def _odd_name(bench: Bench) -> Seen:
    name = os.fsdecode(b"w\xe4lk\xff \n.mcap")
    recording = bench.folder / name
    recording.write_bytes(b"\x89MCAP0\r\nhalf")
    return run(bench, recording)


def _long_name(bench: Bench) -> Seen:
    return run(bench, bench.folder / ("long" * 100))


def _missing_images(bench: Bench) -> Seen:
    recording = bench.copy(material.tum(bench))
    images = sorted((recording / "depth").iterdir())
    for image in images[12:]:
        image.unlink()
    return run(bench, recording)


def _vanishing(bench: Bench) -> Seen:
    """The disk with the recording is pulled out while it is read."""
    recording = bench.copy(material.tum(bench))
    out = bench.folder / "results"

    def pull(process: subprocess.Popen[str]) -> None:
        wait_for(lambda: process.poll() is not None or any(out.glob(".incomplete*")), "a start")
        shutil.rmtree(recording)

    return run(bench, recording, during=pull)


def _growing(bench: Bench) -> Seen:
    """The recorder is still writing."""
    whole = material.bag(bench).read_bytes()
    recording = bench.folder / "growing.mcap"
    recording.write_bytes(whole[: len(whole) // 2])

    def grow(process: subprocess.Popen[str]) -> None:
        out = bench.folder / "results"
        wait_for(lambda: process.poll() is not None or any(out.glob(".incomplete*")), "a start")
        recording.write_bytes(whole[: len(whole) * 3 // 4])

    return run(bench, recording, during=grow)


def _wrong_suffix(bench: Bench) -> Seen:
    return run(bench, bench.copy(material.bag(bench), "walk.bag"))


def _far_or_refused(seen: Seen) -> str:
    """A damaged file is refused in words, or read as far as it goes without being far off."""
    (told,) = seen.facts["ended"]
    if told.unexplained:
        return str(told.unexplained)
    off_m = seen.facts["report"].get("ate_online_rmse_m")
    return "" if off_m is None or off_m < 0.05 else f"{100 * off_m:.1f} cm off, reported as good"


_fault = faults_of(Group.RECORDING)

WHOLE_RUNS = (
    _fault(
        "recorder-killed",
        "the mcap ends at 60 percent, without its index",
        "the frames before are tracked; a warning says that the file is truncated",
        _broken_off,
        tracked(10, "truncated"),
        quick=True,
    ),
    _fault(
        "images-overwritten",
        "200 bytes anywhere in the second half of a db3 are wrong",
        "it is run as far as it goes; no pose said to be good is off by 5 cm",
        _flipped_in_the_middle,
        _far_or_refused,
    ),
    _fault(
        "recording-empty",
        "a bag without messages",
        "refused; the message says what is missing",
        _empty_bag,
        refused("no colour images"),
    ),
    _fault(
        "recording-of-one-frame",
        "a bag with a single pair of images",
        "it is mapped; the message says that a trajectory of one pose cannot be compared",
        _one_frame,
        ended("no comparison with the truth", status=BAD_INPUT),
    ),
    _fault(
        "file-empty",
        "an mcap of no bytes",
        "refused; the message says that it is empty",
        _empty_file,
        refused("empty"),
    ),
    _fault(
        "suffix-wrong",
        "an mcap file is called walk.bag",
        "refused; the message says how to rename it",
        _wrong_suffix,
        refused("rename it"),
    ),
    _fault(
        "recording-missing",
        "there is no such recording",
        "refused; the message lists what is accepted",
        command("run", "/nowhere/walk.mcap", "--out", "results"),
        refused("does not exist", "rosbag2"),
    ),
    _fault(
        "recording-is-a-pipe",
        "the recording is a named pipe that nobody writes",
        "refused at once",
        _pipe,
        refused("pipe.mcap"),
    ),
    _fault(
        "recording-is-a-device",
        "the recording is /dev/zero",
        "refused at once",
        command("run", "/dev/zero", "--out", "results"),
        refused("/dev/zero"),
    ),
    _fault(
        "recording-is-an-empty-folder",
        "the recording is an empty folder called walk.mcap",
        "refused; the message lists what is accepted",
        _directory_called_bag,
        refused("is not a recording"),
    ),
    _fault(
        "name-not-unicode",
        "a damaged recording's name holds bytes that are no text, and a line break",
        "refused; the message can be printed",
        _odd_name,
        refused(),
    ),
    _fault(
        "name-too-long",
        "a recording's name is longer than names may be",
        "refused",
        _long_name,
        refused(),
    ),
    _fault(
        "images-missing",
        "the second half of a TUM folder's depth files is not there",
        "status 2; the results of the frames before are there, the file is named",
        _missing_images,
        tracked(12, "breaks off", ".png", status=BAD_INPUT),
    ),
    _fault(
        "recording-vanishes",
        "the recording's folder is removed while it is read",
        "status 2 and what was read, or nothing where nothing was; the file is named",
        _vanishing,
        ended("cannot be read", status=BAD_INPUT),
    ),
    _fault(
        "recording-grows",
        "the recorder goes on writing while the recording is read",
        "what was there is tracked",
        _growing,
        tracked(5, "truncated"),
    ),
)


FAULTS = WHOLE_RUNS
