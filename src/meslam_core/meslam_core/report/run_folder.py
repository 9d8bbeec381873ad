"""What a run left behind, read back for its report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from meslam_core.camera import PinholeCamera
from meslam_core.errors import EvaluationError, FrameError, MapError, RecordingError
from meslam_core.evaluation.report import truth_entries
from meslam_core.evaluation.trajectory_error import AbsoluteError, absolute_error
from meslam_core.frame_log import FRAMES, FrameTable, read_frame_log
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.reader import read_map
from meslam_core.recordings import open_recording
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.topics import RecordingTopics
from meslam_core.results import MAP, ONLINE_TRAJECTORY, REPORT, TRAJECTORY
from meslam_core.trajectory import Trajectory, read_tum

REMEDY = "make it anew: meslam run RECORDING --out DIR"
MIN_POSES = 2
# What the report shows over time, and how it is called where it was not recorded. The size of the
# map is told at the end in any case; a run of a few frames ends before it is first measured.
OVER_TIME = {
    "residual_m": "residual",
    "loss_distance": "losses",
    "reading_ms": "time of reading",
    "odometry_ms": "time of odometry",
    "tracking_ms": "time of tracking",
    "mapping_ms": "time of mapping",
    "regions": "number of regions",
    "keyframes": "number of keyframes",
    "rss_mb": "memory",
}


@dataclass
class RunFolder:
    """The results of one run.

    Attributes:
        name: to call it by, the folder's.
        path: the folder.
        entries: of `report.json`.
        refined, online: T_map_camera; None where no pose was found.
        frames: of `frames.csv`.
        error, online_error: of the trajectories against the truth.
        camera: its intrinsics.
        map: the stored networks.
        recording: open; where the images come from.
        missing: a sentence for everything that the run has not, and how to get it.
    """

    name: str
    path: Path
    entries: dict[str, Any]
    refined: Trajectory | None = None
    online: Trajectory | None = None
    frames: FrameTable | None = None
    error: AbsoluteError | None = None
    online_error: AbsoluteError | None = None
    camera: PinholeCamera | None = None
    map: NeuralMap | None = None
    recording: Recording | None = None
    missing: list[str] = field(default_factory=list)

    @property
    def first_stamp_ns(self) -> int:
        """Where the run's time begins [ns]."""
        if self.frames is not None and len(self.frames):
            return int(self.frames.stamps_ns[0])
        return int(self.refined.stamps_ns[0]) if self.refined is not None else 0

    def close(self) -> None:
        """Release the recording."""
        if self.recording is not None:
            self.recording.close()


def read_run(
    path: Path,
    truth: Path | None = None,
    recording: Path | None = None,
    lever_arm: bool = False,
) -> RunFolder:
    """Read a run's folder, what it was compared with and what it was made of.

    Args:
        path: what `meslam run --out` or the demo wrote.
        truth: poses in TUM format instead of those that the run names.
        recording: instead of the one that the run names, where that was moved.
        lever_arm: the truth is the pose of another sensor on the same mount.

    Raises:
        EvaluationError: when the folder is not a run's or a file of it is damaged, or when the
            given truth cannot be read.
        RecordingError: when the given recording cannot be read.
    """
    path = Path(path)
    run = RunFolder(path.resolve().name, path, _entries(path))
    run.refined = _trajectory(run, TRAJECTORY)
    run.online = _trajectory(run, ONLINE_TRAJECTORY)
    _read_frames(run)
    run.camera = _intrinsics(run.entries)
    _compare(run, truth, lever_arm)
    _open_map(run)
    _open_recording(run, recording)
    return run


def _entries(path: Path) -> dict[str, Any]:
    file = path / REPORT
    if not path.is_dir():
        raise EvaluationError(f"{path} is no folder; name what `meslam run --out` wrote")
    try:
        entries = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise EvaluationError(
            f"{path} is not the folder of a run: no {REPORT}; {REMEDY}"
        ) from error
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{file} is damaged ({error}); {REMEDY}") from error
    if not isinstance(entries, dict) or not isinstance(entries.get("frames"), int):
        raise EvaluationError(f"{file} does not say how many frames there were; {REMEDY}")
    return entries


def _trajectory(run: RunFolder, name: str) -> Trajectory | None:
    """A trajectory of the run; none where no pose was found."""
    file = run.path / name
    if run.entries.get("frames_tracked") == 0:
        return None
    if not file.is_file():
        raise EvaluationError(f"{run.path} is not whole: no {name}; {REMEDY}")
    trajectory = read_tum(file)
    return trajectory if len(trajectory) >= MIN_POSES else None


def _read_frames(run: RunFolder) -> None:
    """Read what is told of single frames, and say what is not."""
    file = run.path / FRAMES
    table = read_frame_log(file) if file.is_file() else None
    if table is None or not len(table):
        run.missing.append(
            f"State, losses and times of single frames: there is no {FRAMES}; a run of this "
            "version writes it."
        )
        return
    run.frames = table
    unknown = [name for column, name in OVER_TIME.items() if not table.known(column)]
    if unknown:
        run.missing.append(f"Over time: {', '.join(unknown)}; {FRAMES} does not tell.")


def _compare(run: RunFolder, given: Path | None, lever_arm: bool) -> None:
    """Find the errors against the truth."""
    named = _named_path(run.entries, "truth")
    truth_path = given or named
    if truth_path is None:
        run.missing.append("Errors: no true poses are known; name them with --truth FILE.")
        return
    if run.refined is None or run.online is None:
        run.missing.append("Errors: not enough frames got a pose.")
        return
    try:
        truth = read_tum(truth_path)
        hand_eye = lever_arm or (given is None and run.entries.get("lever_arm") is True)
        run.entries |= truth_entries(run.refined, run.online, truth, hand_eye=hand_eye)
        run.error = absolute_error(run.refined, truth, hand_eye=hand_eye)
        run.online_error = absolute_error(run.online, truth, hand_eye=hand_eye)
    except EvaluationError as error:
        if given is not None:
            raise
        run.missing.append(f"Errors along the path: {error}. Name the true poses with --truth.")


def _open_map(run: RunFolder) -> None:
    try:
        stored = read_map(run.path / MAP)
        run.missing += [f"Part of the map: {warning}." for warning in stored.warnings]
        run.map = NeuralMap(stored.regions)
    except MapError as error:
        run.missing.append(f"Views of the map: {error}.")


def _open_recording(run: RunFolder, given: Path | None) -> None:
    path = given or _named_path(run.entries, "recording_path")
    if path is None:
        run.missing.append(
            "Camera images: the run does not say where its recording is; name it with "
            "--recording FILE."
        )
        return
    try:
        run.recording = _opened(path, run.camera, _topics(run.entries))
    except RecordingError as error:
        if given is not None:
            raise
        run.missing.append(f"Camera images: {error}. Name the recording with --recording FILE.")


def _intrinsics(entries: Mapping[str, Any]) -> PinholeCamera | None:
    camera = entries.get("camera")
    with suppress(FrameError, TypeError):
        return PinholeCamera(**camera) if isinstance(camera, dict) else None
    return None


def _topics(entries: Mapping[str, Any]) -> RecordingTopics:
    """The topics that the run read, where its recording has any."""
    topics = entries.get("topics")
    roles = [each.name for each in fields(RecordingTopics)]
    named = topics.items() if isinstance(topics, Mapping) else ()
    return RecordingTopics(
        **{role: name for role, name in named if role in roles and isinstance(name, str)}
    )


def _opened(path: Path, intrinsics: PinholeCamera | None, topics: RecordingTopics) -> Recording:
    """A recording with the intrinsics and topics of the run, which may have been given to it."""
    try:
        recording = open_recording(path, topics=topics)
    except RecordingError:
        if intrinsics is None:
            raise
        return open_recording(path, intrinsics, topics)
    if intrinsics is None or recording.camera == intrinsics:
        return recording
    recording.close()
    return open_recording(path, intrinsics, topics)


def _named_path(entries: Mapping[str, Any], name: str) -> Path | None:
    value = entries.get(name)
    return Path(value) if isinstance(value, str) and value else None
