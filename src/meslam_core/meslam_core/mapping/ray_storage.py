"""Rays of keyframes: some of each in memory, in arrays that training gathers from; all on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.scratch import Record, ScratchFile

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]

# Fewer rays do not show what a keyframe saw; no keyframe is thinned further than this.
LEAST_RAYS = 256
# Beyond the budget the storage grows by this share of it at a time.
CHUNK_SHARE = 0.25
# Denser rays come back from disk when they leave this much of the budget free for new keyframes.
ROOM_SHARE = 0.25


@dataclass(frozen=True)
class Rays:
    """Measured rays in the camera frame.

    Attributes:
        directions: (R, 3) float32 unit vectors.
        distances_m: (R,) float32 distance of the surface along the ray [m].
        colors: (R, 3) float32 in [0, 1].
    """

    directions: torch.Tensor
    distances_m: torch.Tensor
    colors: torch.Tensor

    def __len__(self) -> int:
        return len(self.distances_m)

    def to(self, device: torch.device) -> Rays:
        """The same rays on another device."""
        return Rays(self.directions.to(device), self.distances_m.to(device), self.colors.to(device))


def spread_choice(count: int, kept: int, generator: np.random.Generator) -> Integers:
    """`kept` <= `count` different numbers below `count`, ascending.

    One at random of each of `kept` equal stretches: of pixels in raster order the choice covers
    the image as evenly as they do.
    """
    edges = np.arange(kept + 1) * count // kept
    return edges[:-1] + generator.integers(np.diff(edges))


class RayStorage:
    """A block of rays for each keyframe that training needs now.

    Every keyframe in memory has the same number of rays (repeated where it came with fewer), so
    that a batch over many keyframes is one gather. At most `budget` rays are in memory, 19 bytes
    each: where a further keyframe would exceed it, the number of every keyframe's rays is halved;
    a random half remains, spread over the image. No keyframe is thinned below `LEAST_RAYS`: with
    more than `budget / LEAST_RAYS` keyframes the storage grows after all, in chunks of
    `CHUNK_SHARE` of the budget.

    With a scratch file all rays of every keyframe also go to disk, and keyframes that are not
    needed can leave memory.

    Args:
        rays_per_keyframe: kept of a keyframe as long as the budget allows.
        device: of the rays.
        budget: rays of all keyframes together.
        seed: of the choice of the rays that remain.
        scratch: where keyframes rest; None keeps all in memory.

    Attributes:
        per_keyframe: the number of rays that every keyframe has now.
    """

    def __init__(
        self,
        rays_per_keyframe: int,
        device: torch.device,
        budget: int,
        seed: int,
        scratch: ScratchFile | None,
    ) -> None:
        self.per_keyframe = rays_per_keyframe
        self.device = device
        self.budget = budget
        self._full = rays_per_keyframe
        self._scratch = scratch
        self._records: list[Record] = []
        self._generator = np.random.default_rng(seed)
        # Ray s of the keyframe in block b stands in row b * per_keyframe + s.
        self._directions = torch.empty(0, 3, device=device)
        self._distances = torch.empty(0, device=device)
        self._colors = torch.empty(0, 3, dtype=torch.uint8, device=device)
        # By keyframe its block, -1 while it rests; by block its keyframe, -1 where none is.
        self._block = np.full(16, -1, np.int64)
        self._keyframe: list[int] = []
        self._count = 0

    @property
    def allocated(self) -> int:
        """Rays that memory is held for, used or not."""
        return len(self._distances)

    def add(self, rays: Rays) -> int:
        """Append a keyframe with at least one ray, camera frame, and return its number."""
        number = self._count
        if number == len(self._block):
            self._block = np.concatenate([self._block, np.full(number, -1, np.int64)])
        if self._scratch is not None:
            self._records.append(self._scratch.put(*_to_bytes(rays, self._full)))
        self._count += 1
        self._put(number, rays)
        return number

    def in_memory(self, keyframes: Integers) -> NDArray[np.bool_]:
        """Whether the rays of each of some keyframes can be drawn."""
        found: NDArray[np.bool_] = self._block[keyframes] >= 0
        return found

    def hold(self, wanted: Sequence[int], at_most: int) -> None:
        """Bring some keyframes into memory and let all others leave it.

        Args:
            wanted: keyframes, the most important last.
            at_most: so many are read from disk now; the others may come with a later call.
        """
        if self._scratch is None:
            return
        keep = np.zeros(self._count, bool)
        keep[np.asarray(wanted, np.int64)] = True
        for block, keyframe in enumerate(self._keyframe):
            if keyframe >= 0 and not keep[keyframe]:
                self._block[keyframe], self._keyframe[block] = -1, -1
        self._densify(int(np.count_nonzero(keep)))
        missing = [k for k in dict.fromkeys(reversed(wanted)) if self._block[k] < 0]
        for keyframe in missing[:at_most]:
            self._put(keyframe, self.read(keyframe))

    def rows(self, keyframes: Integers, slots: Integers) -> Integers:
        """Where rays number `slots` of `keyframes` stand; the keyframes are in memory."""
        rows: Integers = self._block[keyframes] * self.per_keyframe + slots
        return rows

    def rays(self, rows: Integers) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Directions, distances [m] and colours in [0, 255] of rows, on the storage's device."""
        at = torch.from_numpy(rows).to(self.device)
        return self._directions[at], self._distances[at], self._colors[at]

    def arrays(self, rows: Integers) -> tuple[Floats, Floats, NDArray[np.uint8]]:
        """The same as arrays, for rows of any shape; the device must be the CPU."""
        return (
            self._directions.numpy().take(rows, axis=0),
            self._distances.numpy().take(rows),
            self._colors.numpy().take(rows, axis=0),
        )

    def read(self, keyframe: int) -> Rays:
        """All rays that are known of a keyframe: those in memory, else those on disk."""
        if self._block[keyframe] >= 0:
            row = self._row(int(self._block[keyframe]))
            colors = self._colors[row].float() / 255.0
            return Rays(self._directions[row], self._distances[row], colors)
        assert self._scratch is not None
        return _from_bytes(self._scratch.get(self._records[keyframe]), self._full)

    def _put(self, keyframe: int, rays: Rays) -> None:
        block = self._room()
        kept = self.per_keyframe
        if len(rays) > kept:
            chosen = spread_choice(len(rays), kept, self._generator)
        else:
            chosen = np.arange(kept) % len(rays)
        slots = torch.from_numpy(chosen)
        row = self._row(block)
        self._directions[row] = rays.directions[slots].to(self.device)
        self._distances[row] = rays.distances_m[slots].to(self.device)
        self._colors[row] = (rays.colors[slots] * 255.0).round().to(self.device, torch.uint8)
        self._block[keyframe], self._keyframe[block] = block, keyframe

    def _room(self) -> int:
        """A free block, by fewer rays of each keyframe or by more storage."""
        while self._over_budget(len(self._keyframe) - self._keyframe.count(-1) + 1):
            self._thin(max(self.per_keyframe // 2, LEAST_RAYS))
        if -1 in self._keyframe:
            return self._keyframe.index(-1)
        self._keyframe.append(-1)
        self._reserve(len(self._keyframe) * self.per_keyframe)
        return len(self._keyframe) - 1

    def _over_budget(self, keyframes: int) -> bool:
        return keyframes * self.per_keyframe > self.budget and self.per_keyframe > LEAST_RAYS

    def _reserve(self, rays: int) -> None:
        stored = len(self._distances)
        if rays <= stored:
            return
        if rays > self.budget:
            self._enlarge(rays + int(CHUNK_SHARE * self.budget))
        elif self.device.type == "cpu":
            # Memory that was never touched costs nothing there.
            self._enlarge(self.budget)
        else:
            self._enlarge(min(max(16 * self.per_keyframe, 2 * stored, rays), self.budget))

    def _enlarge(self, capacity: int) -> None:
        for name in ("_directions", "_distances", "_colors"):
            old = getattr(self, name)
            new = old.new_empty((capacity, *old.shape[1:]))
            new[: len(old)] = old
            setattr(self, name, new)

    def _thin(self, kept: int) -> None:
        """Keep so many rays of every keyframe in memory, in place."""
        before, keyframes = self.per_keyframe, [k for k in self._keyframe if k >= 0]
        for block, keyframe in enumerate(keyframes):
            old = self._row(int(self._block[keyframe]))
            slots = torch.from_numpy(spread_choice(before, kept, self._generator)).to(self.device)
            for rays in (self._directions, self._distances, self._colors):
                # What is overwritten belonged to this keyframe or to one that has moved already.
                rays[block * kept : (block + 1) * kept] = rays[old][slots]
            self._block[keyframe] = block
        self._keyframe = keyframes
        self.per_keyframe = kept

    def _densify(self, keyframes: int) -> None:
        """Denser rays from disk, as soon as so many keyframes leave room for them."""
        density = self.per_keyframe
        room = (1.0 - ROOM_SHARE) * self.budget
        while density < self._full and keyframes * min(2 * density, self._full) <= room:
            density = min(2 * density, self._full)
        if density == self.per_keyframe:
            return
        held = [k for k in self._keyframe if k >= 0]
        self._block[held] = -1
        self._keyframe, self.per_keyframe = [], density
        for keyframe in held:
            self._put(keyframe, self.read(keyframe))

    def _row(self, block: int) -> slice:
        return slice(block * self.per_keyframe, (block + 1) * self.per_keyframe)


def _to_bytes(rays: Rays, count: int) -> tuple[bytes, bytes, bytes]:
    """`count` of the rays, evenly chosen or repeated, as they lie on disk."""
    if len(rays) > count:
        chosen = np.arange(count) * len(rays) // count
    else:
        chosen = np.arange(count) % len(rays)
    colors = (rays.colors.cpu().numpy()[chosen] * np.float32(255.0)).round().astype(np.uint8)
    return (
        rays.directions.cpu().numpy()[chosen].astype(np.float32).tobytes(),
        rays.distances_m.cpu().numpy()[chosen].astype(np.float32).tobytes(),
        colors.tobytes(),
    )


def _from_bytes(data: bytes, count: int) -> Rays:
    numbers = np.frombuffer(data, np.float32, 4 * count).copy()
    colors = np.frombuffer(data, np.uint8, offset=16 * count).astype(np.float32)
    return Rays(
        torch.from_numpy(numbers[: 3 * count].reshape(count, 3)),
        torch.from_numpy(numbers[3 * count :]),
        torch.from_numpy(colors.reshape(count, 3) / np.float32(255.0)),
    )
