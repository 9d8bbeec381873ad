"""Stamped poses, and the TUM text format they are kept in."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meslam_core.errors import EvaluationError, OutputError

NANOSECONDS = 1_000_000_000
MAX_STAMP_NS = 2**63 - 1
MAX_METERS = 1e9
TUM_COLUMNS = "timestamp tx ty tz qx qy qz qw"


@dataclass(frozen=True)
class Trajectory:
    """Poses of one moving frame in one fixed frame, in the order of their stamps.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing [ns].
        poses: (N, 4, 4) float64, T_map_camera [m].

    Raises:
        EvaluationError: when shapes differ, stamps do not increase or a pose is not rigid.
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamps_ns", np.asarray(self.stamps_ns, np.int64))
        object.__setattr__(self, "poses", np.asarray(self.poses, np.float64))
        count = len(self.stamps_ns)
        if self.stamps_ns.ndim != 1 or self.poses.shape != (count, 4, 4):
            raise EvaluationError(
                f"trajectory has stamps {self.stamps_ns.shape} and poses {self.poses.shape}; "
                "expected (N,) and (N, 4, 4)"
            )
        steps = np.diff(self.stamps_ns)
        if np.any(steps <= 0):
            index = int(np.argmax(steps <= 0)) + 1
            raise EvaluationError(
                f"time stamp {stamp_text(self.stamps_ns[index])} of pose {index} does not follow "
                f"{stamp_text(self.stamps_ns[index - 1])}; sort the poses and remove duplicates"
            )
        rotations = self.poses[:, :3, :3]
        deviation = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rigid = (deviation < 1e-3) & (np.linalg.det(rotations) > 0)
        rigid &= np.isfinite(self.poses).all(axis=(1, 2))
        if not rigid.all():
            index = int(np.argmin(rigid))
            at = stamp_text(self.stamps_ns[index])
            raise EvaluationError(f"pose {index} at {at} s is not a finite rigid motion; remove it")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> NDArray[np.float64]:
        """(N, 3) positions [m]."""
        return self.poses[:, :3, 3]

    @property
    def rotations(self) -> NDArray[np.float64]:
        """(N, 3, 3) rotation matrices."""
        return self.poses[:, :3, :3]

    @property
    def length_m(self) -> float:
        """Length of the path through all positions [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def duration_s(self) -> float:
        """Time from the first stamp to the last [s]."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / NANOSECONDS if len(self) else 0.0

    def subset(self, indices: NDArray[np.integer]) -> Trajectory:
        """The poses at `indices` (increasing)."""
        return Trajectory(self.stamps_ns[indices], self.poses[indices])

    def transformed(
        self, T_left: NDArray[np.floating], T_right: NDArray[np.floating] | None = None
    ) -> Trajectory:
        """Every pose replaced by T_left @ pose @ T_right, both (4, 4); T_right may be left out."""
        poses = T_left @ self.poses
        return Trajectory(self.stamps_ns, poses if T_right is None else poses @ T_right)


def read_tum(path: Path) -> Trajectory:
    """Read `timestamp tx ty tz qx qy qz qw` lines; `#` starts a comment; stamps keep every ns.

    Raises:
        EvaluationError: when the file is unreadable, holds no pose or a line is malformed.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(
            f"{path}: poses cannot be read ({error}); expected a text file of `{TUM_COLUMNS}` lines"
        ) from error
    stamps, rows = [], []
    for number, line in enumerate(lines, start=1):
        content = line.split("#", 1)[0].replace(",", " ").split()
        if content:
            stamp, row = _parse(path, number, content)
            stamps.append(stamp)
            rows.append(row)
    if not rows:
        raise EvaluationError(f"{path}: holds no poses; expected `{TUM_COLUMNS}` lines")
    values = np.array(rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    poses[:, :3, 3] = values[:, :3]
    try:
        return Trajectory(np.array(stamps, np.int64), poses)
    except EvaluationError as error:
        raise EvaluationError(f"{path}: {error}") from error


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as TUM text; an existing file is replaced in one step.

    Raises:
        OutputError: when the file cannot be written; nothing half-written is left behind.
    """
    path = Path(path)
    quaternions = np.empty((0, 4))
    if len(trajectory):
        quaternions = Rotation.from_matrix(trajectory.rotations).as_quat(canonical=True)
    lines = [f"# {TUM_COLUMNS}\n"]
    for stamp, position, quaternion in zip(
        trajectory.stamps_ns, trajectory.positions, quaternions, strict=True
    ):
        numbers = " ".join(f"{value:.9f}" for value in (*position, *quaternion))
        lines.append(f"{stamp_text(stamp)} {numbers}\n")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.writelines(lines)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise OutputError(
            f"{path}: the trajectory cannot be written ({error}); choose a folder that exists and "
            "is writable"
        ) from error


def stamp_text(stamp_ns: int) -> str:
    """Exact decimal seconds of a stamp [ns]; a float would lose nanoseconds of today's epoch."""
    sign = "-" if stamp_ns < 0 else ""
    whole, fraction = divmod(abs(int(stamp_ns)), NANOSECONDS)
    return f"{sign}{whole}.{fraction:09d}"


def parsed_stamp(text: str) -> int:
    """The stamp [ns] of decimal seconds, every digit of them.

    Raises:
        ValueError: when it is no finite number, or more than 64 bits hold.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"{text!r} is not a number of seconds") from error
    limit = MAX_STAMP_NS // NANOSECONDS
    # Only comparisons take any exponent; a large one would make millions of digits.
    if not seconds.is_finite() or not -limit <= seconds <= limit:
        raise ValueError(f"{text!r} seconds are out of range")
    return int((seconds * NANOSECONDS).to_integral_value())


def _parse(path: Path, number: int, content: list[str]) -> tuple[int, list[float]]:
    """Stamp [ns] and (tx, ty, tz, qx, qy, qz, qw) of one line."""
    where = f"{path}, line {number}"
    if len(content) != 8:
        raise EvaluationError(f"{where}: {len(content)} values; expected `{TUM_COLUMNS}`")
    try:
        stamp = parsed_stamp(content[0])
        row = [float(value) for value in content[1:]]
    except ValueError as error:
        raise EvaluationError(f"{where}: not a number; expected `{TUM_COLUMNS}`") from error
    if not np.isfinite(row).all() or np.abs(row[:3]).max() > MAX_METERS:
        raise EvaluationError(
            f"{where}: a value is not finite, or a position beyond all places; remove the line"
        )
    norm = float(np.linalg.norm(row[3:]))
    if not 0.9 < norm < 1.1:
        raise EvaluationError(
            f"{where}: quaternion has norm {norm:.3f}, expected 1; the order is qx qy qz qw"
        )
    return stamp, row
