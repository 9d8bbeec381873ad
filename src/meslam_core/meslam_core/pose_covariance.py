"""Covariances of poses, and the text file they are kept in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import EvaluationError
from meslam_core.map.files import cannot_write, write_atomically
from meslam_core.trajectory import parsed_stamp, stamp_text

AXES = ("x", "y", "z", "rx", "ry", "rz")
# Rows and columns of what is written: the upper triangle, row by row.
UPPER = np.triu_indices(6)
COLUMNS = "timestamp " + " ".join(
    f"{AXES[row]}-{AXES[column]}" for row, column in zip(*UPPER, strict=True)
)


@dataclass(frozen=True)
class PoseCovariances:
    """Covariances of stamped poses.

    Attributes:
        stamps_ns: (N,) int64 of the poses [ns].
        matrices: (N, 6, 6) of (translation [m], rotation [rad]) about the camera, map axes.
    """

    stamps_ns: NDArray[np.int64]
    matrices: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps_ns)


def write_covariances(path: Path, covariances: PoseCovariances) -> None:
    """Write a line a pose: its stamp in seconds and the 21 values of the upper triangle.

    Raises:
        OutputError: when the file cannot be written; nothing half-written is left behind.
    """
    lines = [f"# {COLUMNS}\n"]
    for stamp_ns, matrix in zip(covariances.stamps_ns, covariances.matrices, strict=True):
        numbers = " ".join(f"{value:.6e}" for value in matrix[UPPER])
        lines.append(f"{stamp_text(stamp_ns)} {numbers}\n")
    try:
        write_atomically(path, "".join(lines).encode())
    except OSError as error:
        raise cannot_write(path, error) from error


def read_covariances(path: Path) -> PoseCovariances:
    """Read what `write_covariances` wrote; `#` starts a comment.

    Raises:
        EvaluationError: when the file is unreadable or a line is malformed.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(
            f"{path}: covariances cannot be read ({error}); expected `{COLUMNS}` lines"
        ) from error
    stamps, matrices = [], []
    for number, line in enumerate(lines, start=1):
        content = line.split("#", 1)[0].split()
        if not content:
            continue
        try:
            stamps.append(parsed_stamp(content[0]))
            matrices.append(_symmetric([float(value) for value in content[1:]]))
        except (ArithmeticError, ValueError) as error:
            raise EvaluationError(
                f"{path}, line {number}: no stamp and 21 finite numbers; expected `{COLUMNS}`"
            ) from error
    return PoseCovariances(np.array(stamps, np.int64), np.array(matrices).reshape(-1, 6, 6))


def _symmetric(upper: list[float]) -> NDArray[np.float64]:
    """The matrix (6, 6) of its upper triangle; ValueError where that is none."""
    if len(upper) != len(UPPER[0]) or not np.isfinite(upper).all():
        raise ValueError
    matrix = np.zeros((6, 6))
    matrix[UPPER] = upper
    matrix.T[UPPER] = upper
    return matrix
