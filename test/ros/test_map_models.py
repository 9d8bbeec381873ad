"""The map server's models without a node around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored
from data.map_client import model, two_regions

from meslam_core.config import MeslamConfig
from meslam_core.errors import MapError
from meslam_core.map.store import MapStore
from meslam_core.map.union import MapUnion
from meslam_core.regions.grid import RegionGrid
from meslam_ros import region_catalog
from meslam_ros.map_models import MapModels
from meslam_ros.region_catalog import RegionCatalog, RegionEntry


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


def test_what_is_sent_takes_no_more_memory_than_it_may() -> None:
    first, second = two_regions()
    models = MapModels(MeslamConfig(), "map", lambda: 1.5 * first.size_in_memory)
    assert models.add(model(first))
    with pytest.raises(MapError, match="max_map_mb"):
        models.add(model(second))
    assert models.add(model(replace(first, version=first.version + 1))), "takes the first's place"
    assert models.add(model(second, "another map")), "as does the first region of another map"
    assert [entry.index for entry in models.entries()] == [second.index]


def test_a_map_has_no_more_regions_than_can_be_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(region_catalog, "MAX_REGIONS", 1)
    first, second = two_regions()
    catalog = RegionCatalog()
    catalog.add(RegionEntry.of(model(first)))
    with pytest.raises(MapError, match="at most 1 region"):
        catalog.add(RegionEntry.of(model(second)))
    catalog.add(RegionEntry.of(model(replace(first, version=first.version + 1))))
    assert list(catalog.entries) == [first.index]
