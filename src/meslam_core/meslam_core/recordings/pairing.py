"""Which depth image belongs to which colour image."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import RecordingError

TOLERANCE_NS = 20_000_000

logger = logging.getLogger(__name__)


def pair_stamps(
    color_ns: NDArray[np.int64],
    depth_ns: NDArray[np.int64],
    tolerance_ns: int = TOLERANCE_NS,
) -> list[tuple[int, int]]:
    """Pair colour and depth images one to one by their stamps.

    The closest pairs are chosen first, as in `associate.py` of the TUM RGB-D benchmark (Sturm et
    al. 2012). The stamps need not be sorted.

    Args:
        color_ns, depth_ns: (N,) and (M,) stamps [ns].
        tolerance_ns: stamps of a pair differ by less than this [ns].

    Returns:
        Indices (colour, depth) in the order of the colour stamps.
    """
    order = np.argsort(depth_ns, kind="stable")
    ordered = depth_ns[order]
    candidates = []
    for color, stamp in enumerate(color_ns):
        first = int(np.searchsorted(ordered, stamp - tolerance_ns, side="right"))
        last = int(np.searchsorted(ordered, stamp + tolerance_ns, side="left"))
        for depth in order[first:last]:
            candidates.append((abs(int(depth_ns[depth]) - int(stamp)), color, int(depth)))
    candidates.sort()
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, color, depth in candidates:
        if color not in pairs and depth not in taken:
            pairs[color] = depth
            taken.add(depth)
    return sorted(pairs.items(), key=lambda pair: (color_ns[pair[0]], pair[0]))


def ordered_pairs(
    name: str, color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64]
) -> list[tuple[int, int]]:
    """Pair the images of a recording, with strictly increasing colour stamps.

    Images that share a stamp with an earlier one are skipped, images out of order are sorted, and
    images without a partner are left out; a warning says how many.

    Raises:
        RecordingError: when there are no images or no pair at all.
    """
    for kind, stamps in (("colour", color_ns), ("depth", depth_ns)):
        if len(stamps) == 0:
            raise RecordingError(f"{name} has no {kind} images; record colour and depth together")
    color_kept, depth_kept = _first_of_each(color_ns), _first_of_each(depth_ns)
    duplicates = len(color_ns) - len(color_kept)
    if duplicates:
        logger.warning("%s: skipped %d colour images with a repeated stamp", name, duplicates)
    disordered = int(np.count_nonzero(np.diff(color_ns) < 0))
    if disordered:
        logger.warning("%s: sorted %d colour images that were out of order", name, disordered)
    pairs = [
        (int(color_kept[color]), int(depth_kept[depth]))
        for color, depth in pair_stamps(color_ns[color_kept], depth_ns[depth_kept])
    ]
    if not pairs:
        raise RecordingError(
            f"{name} has {len(color_ns)} colour and {len(depth_ns)} depth images, but none lie "
            f"within {TOLERANCE_NS / 1e6:.0f} ms of each other; are both stamped by one clock?"
        )
    alone = len(color_kept) - len(pairs)
    if alone:
        logger.warning("%s: skipped %d colour images without a depth image", name, alone)
    return pairs


def _first_of_each(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices, in the order of the images, of the first image with each stamp."""
    _, first = np.unique(stamps, return_index=True)
    return np.sort(first)
