"""`frames.csv`: a line about every frame of a run, written while it runs."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import EvaluationError
from meslam_core.frame_result import TrackingState
from meslam_core.map.files import cannot_write
from meslam_core.trajectory import parsed_stamp, stamp_text

FRAMES = "frames.csv"
STAMP, STATE, REASON = "stamp_s", "state", "reason"


@dataclass(frozen=True)
class FrameEntry:
    """What is recorded of a frame; None where whoever records does not know it.

    Attributes:
        stamp_ns: of the image [ns]; `stamp_s` in the file, with every digit.
        state: of tracking, by its name.
        reason: why the state is not OK, for people.
        tracked: whether the pose rests on a measurement and is in the trajectory.
        keyframe: whether the frame became a keyframe.
        residual_m: median distance of the frame's points to the mapped surface [m].
        inlier_ratio: share of points near the surface.
        loss_distance, loss_depth, loss_color: mean losses of the training that ended last.
        iterations: optimisation steps of that training.
        reading_ms: time until the frame was read, with decoding, or the wait for it [ms].
        odometry_ms: time of the external odometry [ms].
        tracking_ms: time until the pose was known [ms].
        mapping_ms: time of the training that ended last [ms].
        frame_ms: time since the frame before was done [ms].
        latency_ms: time from when the image was due, or there, until its pose was known [ms].
        skipped: frames passed over since the start.
        keyframes: held so far, of all regions.
        regions: of the map so far.
        map_bytes: size of the map as it would be stored, as last measured.
        rss_mb: memory of the process.
    """

    stamp_ns: int
    state: str
    reason: str = ""
    tracked: bool | None = None
    keyframe: bool | None = None
    residual_m: float | None = None
    inlier_ratio: float | None = None
    loss_distance: float | None = None
    loss_depth: float | None = None
    loss_color: float | None = None
    iterations: int | None = None
    reading_ms: float | None = None
    odometry_ms: float | None = None
    tracking_ms: float | None = None
    mapping_ms: float | None = None
    frame_ms: float | None = None
    latency_ms: float | None = None
    skipped: int | None = None
    keyframes: int | None = None
    regions: int | None = None
    map_bytes: int | None = None
    rss_mb: float | None = None


NUMBERS = tuple(entry.name for entry in dataclasses.fields(FrameEntry))[3:]
COLUMNS = (STAMP, STATE, REASON, *NUMBERS)


class FrameLog:
    """Writes `frames.csv` line by line; a context manager.

    Args:
        path: of the file; an existing one is replaced.

    Raises:
        OutputError: on entry or when adding, when the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO | None = None

    def __enter__(self) -> FrameLog:
        try:
            self._file = self._path.open("w", newline="", encoding="utf-8")
        except OSError as error:
            raise cannot_write(self._path, error) from error
        self._write(COLUMNS)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        assert self._file is not None
        try:
            self._file.close()
        except OSError as failure:
            if error is None:
                raise cannot_write(self._path, failure) from failure

    def add(self, entry: FrameEntry) -> None:
        """Write one frame's line."""
        numbers = [_text(getattr(entry, name)) for name in NUMBERS]
        self._write((stamp_text(entry.stamp_ns), entry.state, entry.reason, *numbers))

    def _write(self, values: tuple[str, ...]) -> None:
        assert self._file is not None, "enter the log first"
        try:
            csv.writer(self._file, lineterminator="\n").writerow(values)
        except OSError as error:
            raise cannot_write(self._path, error) from error


@dataclass(frozen=True)
class FrameTable:
    """What `frames.csv` says.

    Attributes:
        stamps_ns: (N,) int64 of the images [ns].
        states: names of the tracking states.
        reasons: why a state is not OK; empty where it is.
        numbers: (N,) float64 of every further column, NaN where unknown.
    """

    stamps_ns: NDArray[np.int64]
    states: list[str]
    reasons: list[str]
    numbers: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def known(self, name: str) -> bool:
        """Whether any frame has a value in a column."""
        return bool(np.isfinite(self.numbers[name]).any())


def read_frame_log(path: Path) -> FrameTable:
    """Read what a `FrameLog` wrote; columns of other versions are passed over or unknown.

    Raises:
        EvaluationError: when the file is unreadable or a line is malformed.
    """
    stamps: list[int] = []
    states: list[str] = []
    reasons: list[str] = []
    rows: list[list[float]] = []
    number = 1
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file)
            for line in lines:
                number = lines.line_num
                stamps.append(parsed_stamp(line[STAMP]))
                states.append(TrackingState[line[STATE]].name)
                reasons.append(line.get(REASON) or "")
                rows.append([float(line.get(name) or "nan") for name in NUMBERS])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise EvaluationError(f"{path} cannot be read ({error}); repeat the run") from error
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise EvaluationError(
            f"{path}, line {number}: {error!r}; expected the columns {', '.join(COLUMNS[:3])} and "
            "numbers. Repeat the run, or move the file away to go without it"
        ) from error
    table = np.array(rows, np.float64).reshape(-1, len(NUMBERS))
    columns = dict(zip(NUMBERS, table.T, strict=True))
    return FrameTable(np.array(stamps, np.int64), states, reasons, columns)


def _text(value: float | bool | None) -> str:
    """A cell: empty where the value is unknown or not finite."""
    if value is None or not np.isfinite(value):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(int(value))
