"""A region at rest: everything needed to answer for it, and nothing that trains it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import FieldConfig
from meslam_core.field import make_field
from meslam_core.field.model import FieldModel
from meslam_core.field.network import parameter_count
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose


@dataclass(frozen=True)
class Architecture:
    """What must be known of a network beside its weights to compute it.

    Attributes:
        width: units of a hidden layer.
        embedding: sine features.
        truncation_m: distance that one unit of the first output stands for [m].
        density_scale: density per unit of the positive first output [1/m].
    """

    width: int
    embedding: int
    truncation_m: float
    density_scale: float

    @classmethod
    def of(cls, config: FieldConfig) -> Architecture:
        """The part of a field's configuration that its map depends on."""
        return cls(config.width, config.embedding, config.truncation_m, config.density_scale)

    def field_config(self, backend: str = "auto") -> FieldConfig:
        """Configuration of a field of this architecture."""
        return FieldConfig(
            width=self.width,
            embedding=self.embedding,
            truncation_m=self.truncation_m,
            density_scale=self.density_scale,
            backend=backend,
        )

    @property
    def parameter_count(self) -> int:
        """Length of the flat vector of weights."""
        return parameter_count(self.width, self.embedding)


@dataclass(frozen=True, eq=False)
class StoredRegion:
    """One region as it is stored and sent.

    Attributes:
        index: place on the lattice.
        T_map_region: (4, 4) float64; the region's origin is the box's centre [m].
        side_m: side of the box [m].
        architecture: of the network.
        parameters: (P,) float32 in the layout of `field.network.parameter_shapes`.
        mask: what was observed.
        version: grows with every change of the region.
        stamp_ns: of the newest image that the region was trained with [ns].
        keyframes: number of keyframes that trained it.
    """

    index: RegionIndex
    T_map_region: Pose
    side_m: float
    architecture: Architecture
    parameters: NDArray[np.float32]
    mask: ObservedMask
    version: int
    stamp_ns: int
    keyframes: int

    @property
    def half_side_m(self) -> float:
        """Half the side of the box: the unit of region coordinates [m]."""
        return 0.5 * self.side_m

    @property
    def size_in_memory(self) -> int:
        """Of the mask and of the weights, which a network that answers has once more [bytes]."""
        return 2 * self.parameters.nbytes + self.mask.flags.nbytes

    def make_field(self, backend: str = "auto") -> FieldModel:
        """The region's network, ready to be asked."""
        field = make_field(self.architecture.field_config(backend), 0)
        field.load_flat(self.parameters)
        return field


def snapshot(region: Region, stamp_ns: int) -> StoredRegion:
    """A region of the atlas as it is now, awake or at rest; later training does not change it.

    Args:
        region: of the atlas.
        stamp_ns: of the newest image it was trained with [ns].
    """
    mask = region.observed()
    return StoredRegion(
        index=region.index,
        T_map_region=region.T_map_region.copy(),
        side_m=region.side_m,
        architecture=Architecture.of(region.field_config),
        parameters=region.weights(),
        mask=ObservedMask.from_flags(mask.flags.copy(), mask.voxel_m),
        version=region.version,
        stamp_ns=stamp_ns,
        keyframes=len(region.keyframes),
    )
