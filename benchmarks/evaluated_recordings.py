"""The recordings of the evaluation: those in the folder MESLAM_DATA, and simulated ones."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from simulated import simulated
from slam_run import Sequence

from meslam_core.recordings import open_recording
from meslam_core.recordings.tum import is_tum
from meslam_core.simulation.writer import surface_path, truth_path
from meslam_core.trajectory import NANOSECONDS

SIMULATED_FPS = 15
# Scenes and how long they are filmed [s]; None is the whole round.
SCENES: dict[str, float | None] = {
    "room": 20.0,
    "corridor": 30.0,
    "library": 30.0,
    "building": None,
}
# What the first seconds of the building show, a room and a corridor, others show as well.
QUICK_SCENES = ("room", "corridor", "library")
# Of the longest scene, the building.
ROUND_S = 144.0
KINECT_FPS = 30.0
TUM_TRUTH = "groundtruth.txt"
# Poses that lie beside the images of a folder; a T265's are those of another sensor.
FOLDER_TRUTHS = {"reference_poses.txt": False, "t265_poses.txt": True}


@dataclass(frozen=True)
class Source:
    """A recording that can be had.

    Attributes:
        sequence: where it is, or will be once it is made.
        origin: what it is, for people.
        scene: that is simulated; empty for a recording.
        duration_s: of the simulation; None for the whole round.
    """

    sequence: Sequence
    origin: str
    scene: str = ""
    duration_s: float | None = None

    @property
    def frames(self) -> int:
        """How many there are; of a whole round that is still to be made, roughly."""
        if self.there:
            with closing(open_recording(self.sequence.recording)) as recording:
                return len(recording)
        return round(SIMULATED_FPS * (self.duration_s or ROUND_S))

    @property
    def there(self) -> bool:
        """Whether it need not be made first."""
        return self.sequence.recording.exists()

    def made(self) -> None:
        """Simulate it where it is missing."""
        if self.scene:
            length = ["--duration", f"{self.duration_s:g}"] if self.duration_s else []
            path = self.sequence.recording
            simulated(self.scene, path, "--fps", str(SIMULATED_FPS), *length)


def recorded(data: Path, quick: bool = False) -> list[Source]:
    """What the folder MESLAM_DATA holds with true poses, TUM's sequences first.

    Args:
        data: the folder.
        quick: of files in one folder, which share the truth, take the first.
    """
    folders = sorted(path for path in data.iterdir() if path.is_dir())
    by_folder = [list(_in_folder(folder)) for folder in folders]
    found = [each for sources in by_folder for each in (sources[:1] if quick else sources)]
    return sorted(found, key=lambda source: not is_tum(source.sequence.recording))


def _in_folder(folder: Path) -> Iterator[Source]:
    if is_tum(folder):
        if (folder / TUM_TRUTH).exists():
            sequence = Sequence(folder.name, folder, folder / TUM_TRUTH)
            yield Source(sequence, tum_origin(sequence))
        return
    for truth, lever_arm in FOLDER_TRUTHS.items():
        if not (folder / truth).exists():
            continue
        if (folder / "camera.json").exists():
            sequence = Sequence(folder.name, folder, folder / truth, lever_arm)
            kind = "another sensor's poses" if lever_arm else "reference poses"
            yield Source(sequence, f"images with {kind}")
            continue
        for bag in sorted([*folder.glob("*.bag"), *folder.glob("*.db3"), *folder.glob("*.mcap")]):
            sequence = Sequence(bag.stem, bag, folder / truth, lever_arm)
            yield Source(sequence, f"a {bag.suffix} file with reference poses")


def simulations(folder: Path, seconds: float | None = None) -> list[Source]:
    """The simulated recordings in a folder, those that are missing too.

    Args:
        folder: where they are kept.
        seconds: so much of each of QUICK_SCENES; None for all of what SCENES says.
    """
    sources = []
    for scene, usual_s in SCENES.items():
        if seconds is not None and scene not in QUICK_SCENES:
            continue
        duration_s = usual_s if seconds is None else seconds
        length = f"{duration_s:g}s" if duration_s else "round"
        path = folder / f"{scene}_{length}.mcap"
        sequence = Sequence(scene, path, truth_path(path), surface=surface_path(path))
        told = f"{duration_s:g} s" if duration_s else "one round"
        origin = f"simulated D435, {told}, exact poses and surface"
        sources.append(Source(sequence, origin, scene, duration_s))
    return sources


def tum_origin(sequence: Sequence) -> str:
    """Which part of a TUM sequence a folder holds: pairs, seconds, rate and files."""
    with closing(open_recording(sequence.recording)) as recording:
        stamps_ns = np.asarray(recording.stamps_ns)
    rate = NANOSECONDS / float(np.median(np.diff(stamps_ns)))
    seconds = float(stamps_ns[-1] - stamps_ns[0]) / NANOSECONDS
    lines = (sequence.recording / "rgb.txt").read_text().splitlines()
    suffix = Path(next(line.split()[1] for line in lines if line[:1].isdigit())).suffix
    told = f"TUM RGB-D benchmark, {len(stamps_ns)} pairs over {seconds:.1f} s"
    if rate < 0.75 * KINECT_FPS:
        told += f", thinned to {rate:.0f} of the camera's {KINECT_FPS:.0f} frames a second"
    if suffix in (".jpg", ".jpeg"):
        told += ", colour as JPEG instead of PNG"
    return told


def tum_name(name: str) -> str:
    """`fr1/xyz` for a folder of that sequence, whatever it is called exactly; empty for none."""
    found = re.search(r"(?:freiburg|fr)([123])_([a-z0-9_]+)", name, re.IGNORECASE)
    return f"fr{found[1]}/{found[2].lower()}" if found else ""
