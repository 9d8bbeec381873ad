"""Maps that nobody saved and that are there all the same."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored

from meslam_core.config import MeslamConfig
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_interfaces.msg import RegionModel
from meslam_ros.map_keeper import MapKeeper
from meslam_ros.map_models import MapModels
from meslam_ros.node_settings import MapServerSettings
from meslam_ros.region_messages import region_model

FIRST, SECOND, THIRD = (letter * 32 for letter in "abc")


@pytest.fixture(scope="module")
def region() -> StoredRegion:
    return stored(learnt_field(), SphereInRoom())


def model(region: StoredRegion, map_id: str = FIRST, version: int = 1) -> RegionModel:
    return region_model(replace(region, version=version), map_id, "map", "int8")


class Server:
    """A map server's map and its keeper, without a node."""

    def __init__(self, folder: Path, **settings) -> None:
        self.said: list[str] = []
        self.warnings: list[str] = []
        self.models = MapModels(MeslamConfig(), "map")
        self.keeper = MapKeeper(
            self.models,
            folder,
            MapServerSettings(**settings),
            self.said.append,
            self.warnings.append,
        )


def versions(path: Path) -> dict:
    return {entry.index: entry.version for entry in MapStore(path).manifest().regions}


def test_a_map_is_found_again_by_the_next_server(tmp_path, region) -> None:
    first = Server(tmp_path)
    first.models.add(model(region, version=3))
    first.keeper.keep()
    second = Server(tmp_path)
    assert second.keeper.restore() == str(tmp_path / FIRST)
    before, after = first.models.content(), second.models.content()
    assert (after.map_id, after.versions) == (before.map_id, before.versions)
    assert after.data == before.data
    # Tracking still lives: what it has learnt since counts, what it had before is known.
    assert not second.models.add(model(region, version=3))
    assert second.models.add(model(region, version=4))


def test_the_same_map_again_replaces_nothing(tmp_path, region) -> None:
    server = Server(tmp_path / "recent")
    server.models.add(model(region))
    server.models.save(tmp_path / "room.meslam")
    server.keeper.keep()
    server.models.load(tmp_path / "room.meslam")
    assert server.said == []
    server.models.add(model(region, SECOND))
    assert len(server.said) == 1


def test_why_a_map_is_not_kept_is_known_until_it_is(tmp_path, region) -> None:
    folder = tmp_path / "recent"
    folder.write_text("in the way")
    server = Server(folder)
    server.models.add(model(region))
    server.keeper.keep()
    assert str(folder) in server.keeper.failure
    folder.unlink()
    server.keeper.keep()
    assert server.keeper.failure == ""
    assert versions(folder / FIRST) == {(0, 0, 0): 1}


def test_a_map_is_written_only_when_it_has_changed(tmp_path, region) -> None:
    server = Server(tmp_path)
    manifest = tmp_path / FIRST / "manifest.json"
    server.models.add(model(region))
    server.keeper.keep()
    os.utime(manifest, (1, 1))
    server.keeper.keep()
    assert manifest.stat().st_mtime == 1
    server.models.add(model(region, version=2))
    server.keeper.keep()
    assert manifest.stat().st_mtime > 1
    assert versions(tmp_path / FIRST) == {(0, 0, 0): 2}


def test_the_last_state_is_kept_when_another_map_begins(tmp_path, region) -> None:
    """A restarted tracking node, a reset, a loaded map: all replace the one that is served."""
    server = Server(tmp_path)
    server.models.add(model(region, version=7))
    server.models.add(model(region, SECOND))
    assert versions(tmp_path / FIRST) == {(0, 0, 0): 7}
    MapStore(tmp_path / "other.meslam").save([region], GRID, THIRD)
    server.models.load(tmp_path / "other.meslam")
    assert versions(tmp_path / SECOND) == {(0, 0, 0): 1}
    assert server.warnings == []
    assert [map_id in said for map_id, said in zip((FIRST, SECOND), server.said, strict=True)]


def test_a_map_is_kept_in_the_background_and_at_the_end(tmp_path, region) -> None:
    server = Server(tmp_path, keep_period_s=3600.0)
    server.keeper.start()
    server.models.add(model(region))
    server.keeper.close()
    assert versions(tmp_path / FIRST) == {(0, 0, 0): 1}


def test_only_the_newest_maps_remain_and_nothing_else_is_touched(tmp_path, region) -> None:
    foreign = tmp_path / "mine.meslam"
    MapStore(foreign).save([region], GRID, THIRD)
    (tmp_path / ("d" * 32)).mkdir()
    server = Server(tmp_path, kept_maps=2)
    for place, map_id in enumerate((FIRST, SECOND, THIRD)):
        server.models.add(model(region, map_id))
        server.keeper.keep()
        os.utime(tmp_path / map_id / "manifest.json", (place, place))
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {SECOND, THIRD, foreign.name, "d" * 32}


def test_a_damaged_map_is_passed_over(tmp_path, region) -> None:
    server = Server(tmp_path)
    for map_id in (FIRST, SECOND):
        server.models.add(model(region, map_id))
        server.keeper.keep()
    os.utime(tmp_path / FIRST / "manifest.json", (1, 1))
    (tmp_path / SECOND / "manifest.json").write_text("{")
    for file in (tmp_path / SECOND).glob("region_*"):
        file.write_bytes(b"")
    second = Server(tmp_path)
    assert second.keeper.restore() == str(tmp_path / FIRST)
    assert SECOND in second.warnings[0]
    assert second.models.map_id == FIRST


def test_no_folder_can_be_made_and_the_server_goes_on(tmp_path, region) -> None:
    (tmp_path / "file").write_text("")
    server = Server(tmp_path / "file" / "recent")
    server.models.add(model(region))
    server.keeper.keep()
    assert server.models.add(model(region, SECOND))
    assert "not kept" in server.warnings[0]
    assert str(tmp_path / "file") in server.warnings[0]


def test_an_identity_from_the_network_leads_nowhere_else(tmp_path, region) -> None:
    folder = tmp_path / "recent"
    server = Server(folder)
    server.models.add(model(region, "../../evil"))
    server.keeper.keep()
    (kept,) = folder.iterdir()
    assert MapStore(kept).manifest().map_id == "../../evil"
    assert list(tmp_path.iterdir()) == [folder]


def test_nothing_is_kept_unless_wanted(tmp_path, region) -> None:
    server = Server(tmp_path / "recent", kept_maps=0)
    server.models.add(model(region))
    server.keeper.keep()
    assert not (tmp_path / "recent").exists()
    assert server.keeper.restore() == ""
