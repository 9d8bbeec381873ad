"""Files of recordings with every kind of damage, many times."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from data.bag_builder import Storage, aligned_bag
from faults import material
from faults.bench import Bench
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
    Problem,
)
from faults.fault import Group, Seen, SkippedError, faults_of

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


_fault = faults_of(Group.RECORDING)

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
        named(1),
    ),
    _fault(
        "mcap-pages-lost",
        f"{MUTATIONS} mcap files have a page of zeros, or two pages exchanged",
        NAMED,
        mutated(_bag("mcap"), _itself, zeroed, shuffled),
        named(1),
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


FAULTS = MUTATED
