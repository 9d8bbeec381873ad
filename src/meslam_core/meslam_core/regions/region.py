"""A region: a box, its frame in the map, its network and what it has observed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.field import make_field
from meslam_core.field.model import FieldModel
from meslam_core.field.network import parameter_count
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.scratch import Record, ScratchFile
from meslam_core.se3 import Pose, inverse

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class _Rest:
    """Where a region at rest lies on disk: weights, the optimiser's state, the mask."""

    scratch: ScratchFile
    record: Record
    mask_count: int
    mask_voxel_m: float


@dataclass(frozen=True)
class RegionOrigin:
    """What an earlier session stored of a region.

    Attributes:
        version: of the region then.
        data: the bytes it is stored as.
    """

    version: int
    data: bytes


class Region:
    """One network and the space assigned to it.

    A region at rest has neither network nor mask in memory.

    Args:
        index: place on the lattice.
        T_map_region: (4, 4); the region's origin is the box's centre [m].
        side_m: side of the box [m].
        field: the network; its input is region coordinates, [-1, 1] inside the box.
        mask: what was observed, also beyond the box.
        keyframes: numbers of the keyframes that train it, the latest last.
        version: grows with every change.

    Attributes:
        seen: keyframes below this number have been asked whether they see the region.
        unmarked: keyframes whose views the mask does not show yet.
        has_worked: whether it was the working region in this session.
        confirmed: whether the camera is known to be where this region's map has it; after a rest
            the path may have drifted.
        recognised: whether it was known once after a rest.
        known_until: keyframes below this number are from before that rest.
        doubts: keyframes since it woke that did not tell.
        origin: what it was when this session began, where it is from an earlier one.
    """

    def __init__(
        self,
        index: RegionIndex,
        T_map_region: Pose,
        side_m: float,
        field: FieldModel,
        mask: ObservedMask,
        keyframes: Iterable[int] = (),
        version: int = 0,
    ) -> None:
        self.index = index
        self.T_map_region = T_map_region
        self.side_m = side_m
        self.keyframes = list(keyframes)
        self.version = version
        self.seen = 0
        self.unmarked: list[int] = []
        self.has_worked = False
        self.confirmed = True
        self.recognised = False
        self.known_until = 0
        self.doubts = 0
        self.origin: RegionOrigin | None = None
        self.field_config: FieldConfig = field.config
        self._field: FieldModel | None = field
        self._mask: ObservedMask | None = mask
        self._rest: _Rest | None = None

    @property
    def settled(self) -> bool:
        """Whether it knows its box: it has worked, in this session or an earlier one."""
        return self.has_worked or self.origin is not None

    @property
    def untouched(self) -> bool:
        """Whether it is still as an earlier session stored it."""
        return self.origin is not None and self.origin.version == self.version

    @property
    def at_rest(self) -> bool:
        """Whether network and mask lie on disk alone."""
        return self._rest is not None

    @property
    def field(self) -> FieldModel:
        """The network; the region must be awake."""
        assert self._field is not None, f"region {self.index} is at rest"
        return self._field

    @property
    def mask(self) -> ObservedMask:
        """What was observed; the region must be awake."""
        assert self._mask is not None, f"region {self.index} is at rest"
        return self._mask

    @property
    def half_side_m(self) -> float:
        """Half the side of the box: the unit of region coordinates [m]."""
        return 0.5 * self.side_m

    def to_region(self, points: torch.Tensor) -> torch.Tensor:
        """Region coordinates (N, 3) of points (N, 3) in the map frame [m]; differentiable."""
        T = torch.from_numpy(inverse(self.T_map_region)).float().to(points.device)
        if self._is_translation:
            return (points + T[:3, 3]) / self.half_side_m
        return (points @ T[:3, :3].T + T[:3, 3]) / self.half_side_m

    def off_center_m(self, position: NDArray[np.floating]) -> float:
        """Distance of a position (3,), map frame, to the centre along the farthest axis [m].

        Inside the box it is less than half the side.
        """
        local = self.T_map_region[:3, :3].T @ (position - self.T_map_region[:3, 3])
        return float(np.abs(local).max())

    def viewed(self, field: FieldModel, mask: ObservedMask) -> Region:
        """The same region with another network and mask, for who must not see them change."""
        return Region(
            self.index, self.T_map_region, self.side_m, field, mask, self.keyframes, self.version
        )

    def rest(self, scratch: ScratchFile, keyframes: int = 0) -> None:
        """Leave memory, with the network as it was on average over the last steps.

        Args:
            scratch: where to.
            keyframes: how many there are so far.

        Raises:
            OutputError: when the disk does not take it; the region then stays awake.
        """
        if self.at_rest:
            return
        first, second, step = self.field.optimizer_state()
        flags = self.mask.flags.reshape(-1)
        record = scratch.put(
            self.field.average().tobytes(),
            first.tobytes(),
            second.tobytes(),
            int(step).to_bytes(8, "little"),
            np.packbits(flags & 1).tobytes(),
            np.packbits(flags & 2).tobytes(),
        )
        self._rest = _Rest(scratch, record, self.mask.flags.shape[0], self.mask.voxel_m)
        self._field = self._mask = None
        self.known_until = keyframes if self.confirmed else self.known_until
        self.confirmed, self.doubts = False, 0

    def wake(self) -> None:
        """Come back into memory.

        Raises:
            OutputError: when the disk fails.
        """
        rest = self._rest
        if rest is None:
            return
        data = rest.scratch.get(rest.record)
        count = parameter_count(self.field_config.width, self.field_config.embedding)
        weights, first, second = np.frombuffer(data, np.float32, 3 * count).reshape(3, count)
        field = make_field(self.field_config, 0)
        field.load_flat(weights)
        step = int.from_bytes(data[12 * count : 12 * count + 8], "little")
        field.load_optimizer_state(first, second, step)
        self._field, self._mask = field, self._stored_mask(rest, data, count)
        self._rest = None
        rest.scratch.release(rest.record)

    def weights(self) -> Floats:
        """The network's parameters averaged over the last steps, also those at rest."""
        if self._rest is None:
            return self.field.average()
        data = self._rest.scratch.get(self._rest.record)
        count = parameter_count(self.field_config.width, self.field_config.embedding)
        return np.frombuffer(data, np.float32, count).copy()

    def observed(self) -> ObservedMask:
        """The mask, the region's own or read from disk."""
        if self._rest is None:
            return self.mask
        data = self._rest.scratch.get(self._rest.record)
        count = parameter_count(self.field_config.width, self.field_config.embedding)
        return self._stored_mask(self._rest, data, count)

    @staticmethod
    def _stored_mask(rest: _Rest, data: bytes, parameters: int) -> ObservedMask:
        voxels = rest.mask_count**3
        packed = np.frombuffer(data, np.uint8, offset=12 * parameters + 8).reshape(2, -1)
        flags = np.unpackbits(packed[0], count=voxels)
        flags |= np.unpackbits(packed[1], count=voxels) << 1
        return ObservedMask.from_flags(flags.reshape((rest.mask_count,) * 3), rest.mask_voxel_m)

    @property
    def _is_translation(self) -> bool:
        return bool(np.array_equal(self.T_map_region[:3, :3], np.eye(3)))
