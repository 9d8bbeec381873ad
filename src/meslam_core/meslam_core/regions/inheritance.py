"""How a region begins: with nothing, or with what the one beside it has learnt."""

from __future__ import annotations

import numpy as np

from meslam_core.config import MeslamConfig
from meslam_core.field import make_field
from meslam_core.field.network import shifted
from meslam_core.regions.grid import RegionGrid, RegionIndex
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose


def first_region(index: RegionIndex, grid: RegionGrid, config: MeslamConfig, seed: int) -> Region:
    """A region that knows nothing, in its place on the lattice.

    Args:
        index: the place.
        grid: the lattice.
        config: of fields and masks.
        seed: of the network's weights.
    """
    T_map_region = np.eye(4)
    T_map_region[:3, 3] = grid.center(index)
    return _empty(index, T_map_region, grid.side_m, config, seed)


def region_beside(
    parent: Region, index: RegionIndex, grid: RegionGrid, config: MeslamConfig, seed: int
) -> Region:
    """A region that begins as `regions.initialisation` says, by default with its parent's map.

    Args:
        parent: awake; where it has been moved, so is the new one.
        index: place on the lattice.
        grid: the lattice.
        config: of regions and fields.
        seed: of weights that are not inherited.
    """
    steps = grid.center(index) - grid.center(parent.index)
    T_map_region = parent.T_map_region.copy()
    T_map_region[:3, 3] += T_map_region[:3, :3] @ steps
    region = _empty(index, T_map_region, grid.side_m, config, seed)
    how = config.regions.initialisation
    if how == "random":
        return region
    weights = parent.weights()
    if how == "continued":
        weights = shifted(weights, config.field.embedding, steps / parent.half_side_m)
    # The network answers as the parent's does, so it has seen as much.
    region.mask.flags[:] = parent.mask.moved(steps).flags
    region.field.load_flat(weights)
    region.field.load_optimizer_state(*parent.field.optimizer_state())
    return region


def _empty(
    index: RegionIndex, T_map_region: Pose, side_m: float, config: MeslamConfig, seed: int
) -> Region:
    extent = config.regions.mask_extent * 0.5 * side_m
    return Region(
        index=index,
        T_map_region=T_map_region,
        side_m=side_m,
        field=make_field(config.field, seed),
        mask=ObservedMask(extent, config.regions.mask_voxel_m),
    )
