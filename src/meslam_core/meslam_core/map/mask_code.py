"""The observed mask as bits that compress well; `docs/map-format.md` specifies the order.

What a voxel holds is guessed from neighbours that come earlier, and only whether the guess was
wrong is stored. The bits are put together by how sure the guess is, so that the many sure ones
make long runs of zeros, which the compression behind finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED

CLASSES = 10
MARGIN = 2
GUESS = -6
UNOBSERVED_WEIGHT = 1

# Rounded coefficients of a logistic regression on masks of two real rooms and a simulated one.
WEIGHTS = {
    (-1, 0, 0): 2,
    (0, -1, 0): 3,
    (0, 0, -1): 3,
    (-1, 1, 0): 2,
    (-1, 0, 1): 1,
    (0, -1, 1): 1,
    (-1, 1, 1): 1,
    (-1, 1, -1): 1,
    (-2, 0, 0): -2,
}
FACES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))

Bits = NDArray[np.uint8]
Shape = tuple[int, int, int]


@dataclass(frozen=True)
class CodedBits:
    """One bit of every voxel asked about.

    Attributes:
        counts: (CLASSES,) uint32, bits of each class of sureness, the surest last.
        packed: (B,) uint8, all classes' bits one after the other, eight a byte.
    """

    counts: NDArray[np.uint32]
    packed: NDArray[np.uint8]


def encode_mask(flags: NDArray[np.uint8]) -> tuple[CodedBits, CodedBits]:
    """The flags (a, b, c) of a box of voxels as coded bits: OBSERVED, then NEAR_SURFACE.

    Raises:
        MapError: when a surface is near a voxel that was not observed.
    """
    observed = flags & OBSERVED
    near = (flags & NEAR_SURFACE > 0).astype(np.uint8)
    if (near > observed).any():
        raise MapError("the observed mask has surfaces near voxels that were not observed")
    everywhere = np.ones(flags.shape, bool)
    return (
        _encode(observed, everywhere, np.zeros(flags.shape, np.int8)),
        _encode(near, observed > 0, _unobserved_faces(_padded(observed))),
    )


def decode_mask(observed: CodedBits, near: CodedBits, shape: Shape) -> NDArray[np.uint8]:
    """The flags (a, b, c) that `encode_mask` coded.

    Raises:
        MapError: when the bits do not fit the box.
    """
    everywhere = np.ones(shape, bool)
    seen = _decode(observed, everywhere, np.zeros(shape, np.int8))
    close = _decode(near, seen > 0, _unobserved_faces(_padded(seen)))
    flags: NDArray[np.uint8] = seen * OBSERVED | close * NEAR_SURFACE
    return flags


def _encode(bits: Bits, asked: NDArray[np.bool_], extra: NDArray[np.int8]) -> CodedBits:
    padded = _padded(bits)
    score = np.full(bits.shape, GUESS, np.int8) + extra
    for offset, weight in WEIGHTS.items():
        score += np.int8(weight) * _moved(padded, offset).astype(np.int8)
    wrong, sureness = bits ^ (score > 0), np.minimum(np.abs(score), CLASSES - 1)
    x, y, z = np.nonzero(asked)
    order = np.lexsort((4 * x + 2 * y + z, sureness[asked]))
    counts = np.bincount(sureness[asked], minlength=CLASSES)
    return CodedBits(counts.astype(np.uint32), np.packbits(wrong[asked][order]))


def _decode(coded: CodedBits, asked: NDArray[np.bool_], extra: NDArray[np.int8]) -> Bits:
    total = int(coded.counts.astype(np.int64).sum())
    if total != np.count_nonzero(asked) or len(coded.packed) != -(-total // 8):
        raise MapError("the bits of the observed mask do not fit its box")
    wrong = np.unpackbits(coded.packed, count=total)
    ends = np.cumsum(coded.counts, dtype=np.int64)
    next_bit = ends - coded.counts
    padded = np.zeros([size + 2 * MARGIN for size in asked.shape], np.uint8)
    flat = padded.reshape(-1)
    steps = np.array(padded.strides)
    neighbours = [(int(steps @ offset), np.int8(weight)) for offset, weight in WEIGHTS.items()]
    inner_asked, inner_extra = asked.reshape(-1), extra.reshape(-1)
    for places, voxels in _waves(asked.shape, steps):
        chosen = inner_asked[voxels]
        places, voxels = places[chosen], voxels[chosen]
        score = inner_extra[voxels] + np.int8(GUESS)
        for step, weight in neighbours:
            score += weight * flat[places + step].view(np.int8)
        sureness = np.minimum(np.abs(score), CLASSES - 1)
        amounts = np.bincount(sureness, minlength=CLASSES)
        # A stable sort by class meets the queues' bits in the order in which they were put in.
        order = np.argsort(sureness, kind="stable")
        starts = np.repeat(next_bit - np.cumsum(amounts) + amounts, amounts)
        next_bit = next_bit + amounts
        if (next_bit > ends).any():
            raise MapError("the bits of the observed mask do not fit its box")
        flat[places[order]] = wrong[starts + np.arange(len(order))] ^ (score[order] > 0)
    return np.ascontiguousarray(_moved(padded, (0, 0, 0)))


def _waves(
    shape: Shape, steps: NDArray[np.integer]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Voxels of equal 4x + 2y + z, whose neighbours in WEIGHTS all come in earlier waves.

    Yields:
        Their flat places in the padded box, and in the box itself, both in ascending order.
    """
    a, b, c = shape
    x, y = (each.reshape(-1) for each in np.indices((a, b)))
    along = 4 * x + 2 * y
    padded = (x + MARGIN) * steps[0] + (y + MARGIN) * steps[1] + MARGIN
    plain = (x * b + y) * c
    order = np.argsort(along, kind="stable")
    sorted_along = along[order]
    for wave in range(4 * (a - 1) + 2 * (b - 1) + c):
        first, last = np.searchsorted(sorted_along, (wave - c + 1, wave + 1))
        columns = np.sort(order[first:last])
        z = wave - along[columns]
        yield padded[columns] + z, plain[columns] + z


def _padded(bits: Bits) -> Bits:
    return np.pad(bits, MARGIN)


def _moved(padded: Bits, offset: Shape) -> Bits:
    """The bits (a, b, c) at an offset from every voxel; 0 outside the box."""
    box = tuple(
        slice(MARGIN + step, size - MARGIN + step)
        for step, size in zip(offset, padded.shape, strict=True)
    )
    return padded[box]


def _unobserved_faces(observed: Bits) -> NDArray[np.int8]:
    """How much more likely a surface is near (a, b, c): a face without an observed voxel counts."""
    inner = _moved(observed, (0, 0, 0))
    seen = np.zeros(inner.shape, np.int8)
    for offset in FACES:
        seen += _moved(observed, offset).astype(np.int8)
    return np.int8(UNOBSERVED_WEIGHT) * (np.int8(len(FACES)) - seen)
