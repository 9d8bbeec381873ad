"""`meslam mesh`, `query`, `info` and `merge` with one map and with several."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from click.testing import Result
from data.analytic_scene import GRID, SphereInRoom
from typer.testing import CliRunner

from meslam_core.cli import app
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.map_info import box_volume_m3


def meslam(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def halves(tmp_path: Path, region: StoredRegion) -> list[Path]:
    """Two maps of one room: what was seen below x = 0.3, and above x = -0.3."""
    mask = region.mask
    x = (np.arange(len(mask.flags)) + 0.5) * mask.voxel_m - mask.half_extent_m
    paths = [tmp_path / "left.meslam", tmp_path / "right.meslam"]
    for path, chosen in zip(paths, (x < 0.3, x > -0.3), strict=True):
        part = replace(region, mask=type(mask).from_flags(mask.flags.copy(), mask.voxel_m))
        part.mask.flags[~chosen] = 0
        MapStore(path).save([part], GRID)
    return paths


def test_mesh_of_several_maps(halves: list[Path], tmp_path: Path, scene: SphereInRoom) -> None:
    areas = {}
    for name, maps in (("left", halves[:1]), ("right", halves[1:]), ("both", halves)):
        out = tmp_path / f"{name}.ply"
        result = meslam("mesh", *maps, "--out", out, "--resolution", 0.06)
        assert result.exit_code == 0, result.stderr
        areas[name] = o3d.io.read_triangle_mesh(str(out)).get_surface_area()
    whole = 6 * (2 * scene.wall_m) ** 2 + 4 * np.pi * scene.radius_m**2
    assert areas["both"] == pytest.approx(whole, rel=0.03)
    assert max(areas["left"], areas["right"]) < 0.75 * whole


def test_query_of_several_maps(halves: list[Path], tmp_path: Path) -> None:
    np.save(tmp_path / "points.npy", np.array([[-1.0, 0.0, 0.0], [1.0, 0, 0], [0, 0, 9.0]]))
    known = {}
    for name, maps in (("left", halves[:1]), ("both", halves)):
        out = tmp_path / f"{name}.npy"
        result = meslam("query", *maps, "--points", tmp_path / "points.npy", "--out", out)
        assert result.exit_code == 0, result.stderr
        known[name] = np.load(out, allow_pickle=False)["occupancy"].tolist()
    assert known == {"left": [0, -1, -1], "both": [0, 0, -1]}


def test_merge_and_ask_the_merged_map(halves: list[Path], tmp_path: Path) -> None:
    merged = tmp_path / "room.meslam"
    result = meslam("merge", *halves, "--out", merged)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == f"{merged}: 2 regions of 2 maps"
    facts = json.loads(meslam("info", merged, "--json").stdout)
    together = json.loads(meslam("info", *halves, "--json").stdout)
    assert facts["regions"] == together["regions"] == 2
    assert facts["observed_volume_m3"] == pytest.approx(together["observed_volume_m3"])
    assert facts["bounds_low_m"] == together["bounds_low_m"]


def test_merge_names_damage_and_uses_the_rest(halves: list[Path], tmp_path: Path) -> None:
    store = MapStore(halves[1])
    loaded = store.load()
    store.save([*loaded.regions, replace(loaded.regions[0], index=(1, 0, 0))], GRID)
    damaged = next(halves[1].glob("region_1_*"))
    damaged.write_bytes(b"gone")
    result = meslam("merge", *halves, "--out", tmp_path / "room.meslam")
    assert result.exit_code == 2
    assert damaged.name in result.stderr
    assert "left.meslam or " in result.stderr
    assert len(MapStore(tmp_path / "room.meslam").load().regions) == 2


def test_merge_refuses_what_is_no_map(halves: list[Path], tmp_path: Path) -> None:
    result = meslam("merge", halves[0], tmp_path / "none.meslam", "--out", tmp_path / "room")
    assert result.exit_code == 2
    assert "none.meslam" in result.stderr
    assert not (tmp_path / "room").exists()


def test_info_tells_sizes_and_volumes(halves: list[Path], region: StoredRegion) -> None:
    facts = json.loads(meslam("info", *halves, "--json").stdout)
    sizes = [sum(file.stat().st_size for file in path.iterdir()) for path in halves]
    assert [each["bytes"] for each in facts["maps"]] == sizes
    assert facts["bytes"] == sum(sizes)
    assert facts["observed_volume_m3"] == pytest.approx(region.mask.observed_volume_m3)
    assert facts["box_volume_m3"] == pytest.approx(30.0)
    assert facts["bytes_per_m3"] == pytest.approx(sum(sizes) / facts["observed_volume_m3"])
    for path, listed in zip(halves, facts["region_list"], strict=True):
        file = next(path.glob("region_*"))
        assert listed["map"] == str(path)
        assert listed["bytes"] == file.stat().st_size
        assert listed["bytes_per_m3"] == pytest.approx(
            listed["bytes"] / listed["observed_volume_m3"]
        )
        assert listed["bytes_per_box_m3"] == pytest.approx(listed["bytes"] / 30.0)


def test_info_prints_a_line_a_region(halves: list[Path]) -> None:
    lines = meslam("info", *halves).stdout.splitlines()
    assert "bytes/m^3" in lines[-3]
    for path, line in zip(halves, lines[-2:], strict=True):
        assert str(next(path.glob("region_*")).stat().st_size) in line


def test_boxes_count_once_where_they_overlap(small_region: StoredRegion) -> None:
    side = small_region.side_m
    T_map_region = np.eye(4)
    regions = []
    for index in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (9, 9, 9)):
        T_map_region[:3, 3] = GRID.center(index)
        regions.append(replace(small_region, index=index, T_map_region=T_map_region.copy()))
    expected = 4 - 2 * 0.2
    assert box_volume_m3(regions) == pytest.approx(expected * side**3, rel=0.01)
    turned = replace(small_region, T_map_region=regions[0].T_map_region[[1, 2, 0, 3]][:, :])
    assert box_volume_m3([regions[0], turned]) == pytest.approx(side**3, rel=0.01)
