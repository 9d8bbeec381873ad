"""A scene whose map is known exactly, learnt once for all tests of this folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID, SIDE_M, SphereInRoom, learnt_field, stored

from meslam_core.config import FieldConfig
from meslam_core.field import make_field
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.regions.observed_mask import ObservedMask


@pytest.fixture(scope="session")
def scene() -> SphereInRoom:
    return SphereInRoom()


@pytest.fixture(scope="session")
def region(scene: SphereInRoom) -> StoredRegion:
    """The whole scene in one region."""
    return stored(learnt_field(), scene)


@pytest.fixture(scope="session")
def neighbour(scene: SphereInRoom) -> StoredRegion:
    """The next region along x, which continues the first one's network."""
    center = GRID.center((1, 0, 0))
    return stored(learnt_field(), scene, (1, 0, 0), (center[0], center[1], center[2]))


@pytest.fixture(scope="session")
def neural_map(region: StoredRegion) -> NeuralMap:
    return NeuralMap([region])


@pytest.fixture
def small_region() -> StoredRegion:
    """A region of a few hundred bytes with a random network, for tests of single bytes."""
    config = FieldConfig(width=16, embedding=8, backend="torch")
    mask = ObservedMask(0.4, 0.1)
    mask.flags[2:5, 3:6, 1:2] = 3
    return StoredRegion(
        index=(1, -2, 3),
        T_map_region=np.array(
            [[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, -0.2], [0.0, 0.0, 1.0, 1 / 3], [0, 0, 0, 1]]
        ),
        side_m=SIDE_M,
        architecture=Architecture.of(config),
        parameters=make_field(config, 7).flat(),
        mask=mask,
        version=4,
        stamp_ns=1_700_000_000_123_456_789,
        keyframes=9,
    )


@pytest.fixture
def two_small_regions(small_region: StoredRegion) -> list[StoredRegion]:
    """Two neighbours on the lattice GRID."""
    regions = []
    for index in ((0, 0, 0), (1, 0, 0)):
        T_map_region = np.eye(4)
        T_map_region[:3, 3] = GRID.center(index)
        regions.append(replace(small_region, index=index, T_map_region=T_map_region))
    return regions


@pytest.fixture
def saved(tmp_path: Path, two_small_regions: list[StoredRegion]) -> MapStore:
    """A map of two regions."""
    store = MapStore(tmp_path / "flat.meslam")
    store.save(two_small_regions, GRID)
    return store
