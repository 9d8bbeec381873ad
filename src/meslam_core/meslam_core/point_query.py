"""Points from a file, asked of a map, answers to a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.map.files import cannot_write, produce_atomically
from meslam_core.map.neural_map import NeuralMap

# Points that are answered at a time: a second or less.
PORTION = 1_000_000
ANSWER = np.dtype(
    [
        ("occupancy", np.int8),
        ("probability", np.float32),
        ("density", np.float32),
        ("distance", np.float32),
        ("color", np.uint8, 3),
    ]
)
"""What is known of a point.

occupancy: -1 unknown, 0 free, 100 occupied; probability: of being occupied, 0.5 where unknown;
density: [1/m], NaN where unknown; distance: signed, to the nearest surface, positive behind it [m],
saturating at about the truncation distance, NaN where unknown; color: RGB, 0 where unknown.
"""


def read_points(path: Path) -> NDArray[np.float64]:
    """Points (N, 3) [m, map frame] of a `.npy` file.

    Raises:
        MapError: when the file is no such array; pickled objects are refused.
    """
    expected = "expected a .npy file of an (N, 3) array of numbers: x, y, z in the map frame [m]"
    try:
        # Mapped, an array cannot be larger than its file, whatever the header says.
        points = np.load(path, mmap_mode="r", allow_pickle=False)
    # numpy lets the errors of the header's parser through.
    except Exception as error:
        raise MapError(f"{path} cannot be read as points ({error}); {expected}") from error
    if not isinstance(points, np.ndarray):
        raise MapError(f"{path} holds several arrays; {expected}")
    numeric = np.issubdtype(points.dtype, np.floating) or np.issubdtype(points.dtype, np.integer)
    if not numeric or points.ndim != 2 or points.shape[1] != 3:
        raise MapError(f"{path} holds {points.dtype} {points.shape}; {expected}")
    if not np.isfinite(points).all():
        raise MapError(f"{path} holds points that are not finite; {expected}")
    return points.astype(np.float64)


def answer(
    neural_map: NeuralMap,
    points: NDArray[np.floating],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> NDArray[Any]:
    """What a map knows of points (N, 3) in its frame: (N,) of dtype `ANSWER`.

    Args:
        neural_map: that is asked.
        points: in its frame [m].
        progress: called with the number of answers and their total.
    """
    answers = np.zeros(len(points), ANSWER)
    for start in range(0, len(points), PORTION):
        portion = slice(start, start + PORTION)
        _fill(answers[portion], neural_map, points[portion])
        progress(min(start + PORTION, len(points)), len(points))
    return answers


def _fill(answers: NDArray[Any], neural_map: NeuralMap, points: NDArray[np.floating]) -> None:
    answers["occupancy"], answers["probability"] = neural_map.occupancy(points)
    values = neural_map.values(points)
    offset = values.distance - np.float32(neural_map.surface_level)
    answers["distance"] = offset * np.float32(neural_map.truncation_m)
    answers["density"] = neural_map.density_scale * np.maximum(values.distance, 0.0)
    answers["color"] = np.nan_to_num(np.round(255.0 * values.color)).astype(np.uint8)


def write_answers(path: Path, answers: NDArray[Any]) -> None:
    """Write answers as a `.npy` file, whole or not at all.

    Raises:
        OutputError: when the place cannot be written.
    """
    try:
        produce_atomically(path, lambda file: np.save(file, answers, allow_pickle=False))
    except OSError as error:
        raise cannot_write(path, error) from error
