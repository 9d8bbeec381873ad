"""The map server's models without a node around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored

from meslam_core.config import MeslamConfig
from meslam_core.map.store import MapStore
from meslam_core.map.union import MapUnion
from meslam_core.regions.grid import RegionGrid
from meslam_ros.map_models import MapModels


def test_merged_maps_of_two_lattices_are_served_and_stored_as_they_are(tmp_path: Path) -> None:
    first = stored(learnt_field(), SphereInRoom())
    T_map_region = np.eye(4)
    T_map_region[:3, 3] = [0.7, -0.4, 0.2]
    second = replace(first, T_map_region=T_map_region)
    other_grid = RegionGrid(T_map_region[:3, 3], GRID.side_m, 0.3)
    paths = [tmp_path / "first.meslam", tmp_path / "second.meslam"]
    for path, region, grid in zip(paths, (first, second), (other_grid, GRID), strict=True):
        MapStore(path).save([region], grid)
    MapUnion(paths).save(tmp_path / "both.meslam")
    models = MapModels(MeslamConfig(), "map")
    assert models.load(tmp_path / "both.meslam") == []
    assert len(models.entries()) == 2
    assert len(models.snapshot().map.regions) == 2
    assert models.save(tmp_path / "again.meslam") == 2
    before, after = (MapStore(tmp_path / f"{name}.meslam").load() for name in ("both", "again"))
    assert after.encoded == before.encoded
    assert after.map_id == before.map_id
    assert np.array_equal(after.grid.origin, other_grid.origin)
    assert after.grid.overlap == 0.3
