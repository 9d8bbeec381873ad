"""Recordings that are damaged, empty, or something else."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from data.bag_builder import BagBuilder, Storage, aligned_bag
from faults import material
from faults.bench import Bench, wait_for
from faults.damage import (
    Damage,
    damaged,
    flipped,
    flipped_early,
    garbled,
    shuffled,
    truncated,
    zeroed,
)
from faults.expectations import (
    BAD_INPUT,
    Problem,
    command,
    ended,
    refused,
    run,
    tracked,
)
from faults.fault import Fault, Group, Seen, SkippedError

MUTATIONS = 60
SHORT = 6
SLOWEST_S = 20.0


def read_through(recording: Path) -> str:
    """Read a recording to its end as a run does: "whole", or what the error says.

    Raises:
        Whatever is not made for people.
    """
    from meslam_core.errors import RecordingError
    from meslam_core.recordings import open_recording

    try:
        opened = open_recording(recording)
        try:
            for _ in opened.frames():
                pass
        finally:
            opened.close()
    except RecordingError as error:
        return str(error)
    return "whole"


def mutated(
    source: Callable[[Bench], Path], files: Callable[[Path], list[Path]], *damages: Damage
) -> Callable[[Bench], Seen]:
    """Damage one of a recording's files again and again, and read what is left."""

    def inject(bench: Bench) -> Seen:
        whole = source(bench)
        outcomes: Counter[str] = Counter()
        wrong = []
        for seed in range(MUTATIONS):
            recording = bench.copy(whole, f"{seed}{whole.suffix}")
            choices = files(recording)
            file = choices[seed % len(choices)]
            damaged(file, damages[seed % len(damages)], seed)
            begun = time.monotonic()
            try:
                told = read_through(recording)
            except Exception as error:
                wrong.append(f"seed {seed}, {file.name}: {type(error).__name__}: {error}")
                continue
            if time.monotonic() - begun > SLOWEST_S:
                wrong.append(f"seed {seed}, {file.name}: {time.monotonic() - begun:.0f} s")
            outcomes["read" if told == "whole" else "refused"] += 1
            if told != "whole" and recording.name not in told and file.name not in told:
                wrong.append(f"seed {seed}: the file is not named: {told}")
            shutil.rmtree(recording) if recording.is_dir() else recording.unlink()
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(outcomes.items()))
        return Seen(f"{MUTATIONS} damaged files: {counts}", {"wrong": wrong, "outcomes": outcomes})

    return inject


def named(refusals: int) -> Problem:
    """Every damage that was noticed was named, and at least so many were noticed."""

    def problem(seen: Seen) -> str:
        if seen.facts["wrong"]:
            return f"{len(seen.facts['wrong'])} of {MUTATIONS}: {seen.facts['wrong'][0]}"
        refused_ = seen.facts["outcomes"]["refused"]
        return "" if refused_ >= refusals else f"only {refused_} were noticed"

    return problem


def _bag(storage: Storage) -> Callable[[Bench], Path]:
    def short(bench: Bench) -> Path:
        folder = material.shared(
            bench,
            f"short-{storage}",
            lambda target: aligned_bag(list(material.frames()[:SHORT]), target, storage),
        )
        return next(file for file in folder.rglob("*") if file.suffix == f".{storage}")

    return short


def _bag_folder(bench: Bench) -> Path:
    return _bag("mcap")(bench).parent


def _itself(recording: Path) -> list[Path]:
    return [recording]


def _below(pattern: str) -> Callable[[Path], list[Path]]:
    return lambda recording: sorted(recording.glob(pattern))


def _real(bench: Bench) -> Path:
    """The first images of a real recording, as a folder of its own."""
    whole = bench.data / "tum_fr1_xyz" if bench.data else None
    if whole is None or not whole.is_dir():
        raise SkippedError("MESLAM_DATA has no tum_fr1_xyz")

    def make(target: Path) -> None:
        for kind in ("rgb", "depth"):
            lines = [
                line for line in (whole / f"{kind}.txt").read_text().splitlines() if line[0] != "#"
            ][: SHORT + 2]
            (target / f"{kind}.txt").write_text("\n".join(lines) + "\n")
            (target / kind).mkdir()
            for line in lines:
                name = line.split()[1]
                shutil.copyfile(whole / name, target / name)
        shutil.copyfile(whole / "camera.json", target / "camera.json")

    return material.shared(bench, "short-tum-real", make)


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


def _fault(
    name: str,
    injected: str,
    expected: str,
    inject: Callable[[Bench], Seen],
    problem: Problem,
    quick: bool = False,
) -> Fault:
    return Fault(name, Group.RECORDING, injected, expected, inject, problem, quick=quick)


NAMED = "each is read as far as it goes or refused; the message names the file"
MUTATED = (
    _fault(
        "mcap-truncated",
        f"{MUTATIONS} mcap files are cut off at random places",
        NAMED,
        mutated(_bag("mcap"), _itself, truncated),
        named(5),
    ),
    _fault(
        "mcap-flipped",
        f"{MUTATIONS} mcap files have wrong bits anywhere, or among their first bytes",
        NAMED,
        mutated(_bag("mcap"), _itself, flipped, flipped_early),
        named(20),
    ),
    _fault(
        "mcap-pages-lost",
        f"{MUTATIONS} mcap files have a page of zeros, or two pages exchanged",
        NAMED,
        mutated(_bag("mcap"), _itself, zeroed, shuffled),
        named(20),
    ),
    _fault(
        "db3-truncated",
        f"{MUTATIONS} db3 files are cut off at random places",
        NAMED,
        mutated(_bag("db3"), _itself, truncated),
        named(50),
    ),
    _fault(
        "db3-flipped",
        f"{MUTATIONS} db3 files have wrong bits anywhere, or among their first bytes",
        NAMED,
        mutated(_bag("db3"), _itself, flipped, flipped_early),
        named(1),
    ),
    _fault(
        "db3-pages-lost",
        f"{MUTATIONS} db3 files have a page of zeros, or two pages exchanged",
        NAMED,
        mutated(_bag("db3"), _itself, zeroed, shuffled),
        named(10),
    ),
    _fault(
        "ros1-bag-truncated",
        f"{MUTATIONS} ROS 1 bags are cut off at random places",
        NAMED,
        mutated(_bag("bag"), _itself, truncated),
        named(50),
    ),
    _fault(
        "ros1-bag-flipped",
        f"{MUTATIONS} ROS 1 bags have wrong bits anywhere, or among their first bytes",
        NAMED,
        mutated(_bag("bag"), _itself, flipped, flipped_early),
        named(1),
    ),
    _fault(
        "metadata-yaml-garbled",
        f"{MUTATIONS} rosbag2 folders have a garbled metadata.yaml",
        NAMED,
        mutated(_bag_folder, _below("metadata.yaml"), garbled, flipped),
        named(5),
    ),
    _fault(
        "png-colour-damaged",
        f"{MUTATIONS} colour PNGs are cut off or have wrong bits",
        NAMED,
        mutated(material.tum, _below("rgb/*.png"), truncated, flipped, flipped_early),
        named(10),
    ),
    _fault(
        "png-depth-damaged",
        f"{MUTATIONS} depth PNGs are cut off or have wrong bits",
        NAMED,
        mutated(material.tum, _below("depth/*.png"), truncated, flipped, flipped_early),
        named(10),
    ),
    _fault(
        "tum-lists-garbled",
        f"{MUTATIONS} TUM folders have garbled lists",
        NAMED,
        mutated(material.tum, _below("*.txt"), garbled),
        named(5),
    ),
    _fault(
        "camera-json-garbled",
        f"{MUTATIONS} folders have a garbled camera.json",
        NAMED,
        mutated(material.folder, _below("camera.json"), garbled, flipped),
        named(20),
    ),
    _fault(
        "real-images-damaged",
        f"{MUTATIONS} images and lists of a real Kinect recording are damaged",
        NAMED,
        mutated(_real, _below("*/*.png"), truncated, flipped, zeroed),
        named(10),
    ),
)
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
        lambda seen: _far_or_refused(seen),
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


def _far_or_refused(seen: Seen) -> str:
    """A damaged file is refused in words, or read as far as it goes without being far off."""
    (told,) = seen.facts["ended"]
    if told.unexplained:
        return str(told.unexplained)
    off_m = seen.facts["report"].get("ate_online_rmse_m")
    return "" if off_m is None or off_m < 0.05 else f"{100 * off_m:.1f} cm off, reported as good"


FAULTS = MUTATED + WHOLE_RUNS
