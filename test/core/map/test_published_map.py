"""A run's map takes the place of an earlier run's: at every instant one of the two is there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from data.analytic_scene import GRID
from data.killed_process import killed_at_call
from data.stored_maps import Regions, changed, resealed, versions

from meslam_core.errors import OutputError
from meslam_core.map.store import MapStore
from meslam_core.results import MAP, ResultFolder


def test_a_new_map_takes_the_place_of_the_earlier_one(
    tmp_path: Path, two_small_regions: Regions
) -> None:
    for regions in (two_small_regions, [changed(two_small_regions[0])]):
        with ResultFolder(tmp_path) as results:
            MapStore(results.incomplete(MAP)).save(regions, GRID)
            map_id = MapStore(results.incomplete(MAP)).manifest().map_id
            results.publish()
    stored = MapStore(tmp_path / MAP)
    assert versions(stored) == {(0, 0, 0): 5}
    assert stored.manifest().map_id == map_id
    assert sorted(file.name for file in tmp_path.iterdir()) == [MAP]


def test_killed_at_every_step_of_publishing_there_is_a_map(
    tmp_path: Path, two_small_regions: Regions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child publishes and is killed before each call that changes the disk, one by one."""
    new = [changed(region) for region in two_small_regions]
    found = []
    for number in range(1, 100):
        place = tmp_path / str(number)
        MapStore(place / MAP).save(two_small_regions, GRID)

        def publish(place: Path = place) -> None:
            with ResultFolder(place) as results:
                MapStore(results.incomplete(MAP)).save(new, GRID)
                results.publish()

        status = killed_at_call(number, publish, monkeypatch)
        found.append(versions(MapStore(place / MAP))[(0, 0, 0)])
        publish()
        assert [file.name for file in place.iterdir()] == [MAP], "what the killed one left stays"
        if status == 0:
            break
    assert len(found) > 15
    assert found == sorted(found)
    assert {found[0], found[-1]} == {4, 5}


def test_a_newer_map_is_not_replaced(tmp_path: Path, two_small_regions: Regions) -> None:
    store = MapStore(tmp_path / MAP)
    store.save(two_small_regions, GRID)
    manifest = store.path / "manifest.json"
    manifest.write_bytes(resealed(json.loads(manifest.read_bytes()) | {"version": 2}))
    with pytest.raises(OutputError, match="newer"), ResultFolder(tmp_path):
        pass
    assert len(list(store.path.iterdir())) == 3
