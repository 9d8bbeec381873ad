"""Fuzzing of what a run leaves behind and other commands read again."""

from __future__ import annotations

import tempfile
from pathlib import Path
from random import Random

from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path
from fuzz.mutation import Parts, mutated_parts
from fuzz.recording_targets import files_below
from fuzz.region_bytes import mutated_region
from fuzz.target import Target

from meslam_core.config import MeslamConfig
from meslam_core.pipeline import run
from meslam_core.report.run_folder import read_run

FRAMES = 4
SETTINGS = (
    "field.width=16",
    "field.embedding=16",
    "keyframes.rays=512",
    "mapping.first_iterations=5",
    "mapping.iterations=2",
    "mapping.keyframe_iterations=2",
    "mapping.final_iterations=2",
)


def _seeds() -> list[Parts]:
    frames = [frame_at(pose, number) for number, pose in enumerate(path(FRAMES))]
    with tempfile.TemporaryDirectory() as folder:
        run(MemoryRecording(frames), MeslamConfig.from_overrides(SETTINGS), Path(folder) / "out")
        parts = files_below(Path(folder) / "out")
    return [{_as_text(name): data for name, data in parts.items()}]


def _as_text(name: str) -> str:
    """CSV is text for the mutation."""
    return name.replace(".csv", ".csv.txt")


def _run_folder(parts: Parts, folder: Path) -> str:
    for name, data in parts.items():
        file = folder / name.replace(".csv.txt", ".csv")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    read = read_run(folder)
    try:
        return " ".join(text.split(":")[0] for text in read.missing)
    finally:
        read.close()


def _mutated_run(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    return mutated_parts(parts, others, rng, mutated_region)


TARGETS = [
    Target(
        "run folder",
        "report.json, trajectories, frames.csv, map",
        _seeds,
        _run_folder,
        _mutated_run,
    )
]
