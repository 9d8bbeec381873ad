"""Going on with a stored map: in its frame, without forgetting it, without touching the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.textured_room import surface_distance_m

from meslam_core.continuation import Continuation, _awake, read_continuation, read_start_pose
from meslam_core.errors import ConfigError, MapError
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.mapping.replay import remembered_views
from meslam_core.pipeline import RunOptions, RunOutcome, run
from meslam_core.se3 import exp, inverse, to_quaternion
from meslam_core.slam import T_BODY_OPTICAL, Slam
from meslam_core.trajectory import read_tum, write_tum

START = 9
FAR = (4, 0, 0)


@pytest.fixture(scope="module")
def stored(finished_run, tmp_path_factory) -> Path:
    """The room's map with another region, far away."""
    path = tmp_path_factory.mktemp("stored") / "map.meslam"
    loaded = MapStore(finished_run.out / "map.meslam").load()
    (region,) = loaded.regions
    T_map_far = region.T_map_region.copy()
    T_map_far[:3, 3] = loaded.grid.center(FAR)
    far = replace(region, index=FAR, T_map_region=T_map_far)
    MapStore(path).save([region, far], loaded.grid, loaded.map_id)
    return path


@pytest.fixture(scope="module")
def second(stored, quick_config, room_frames, room_poses, tmp_path_factory) -> RunOutcome:
    """A session that starts a centimetre and a degree beside where it is said to."""
    beside = room_poses[START] @ exp(np.array([0.01, 0.0, 0.005, 0.0, 0.017, 0.0]))
    options = RunOptions(continuation=Continuation.read(stored, beside))
    out = tmp_path_factory.mktemp("second")
    outcome = run(MemoryRecording(room_frames[START:]), quick_config, out, options)
    outcome.report["out"] = out
    return outcome


def test_the_frame_is_that_of_the_stored_map(second, room_poses):
    trajectory = read_tum(second.report["out"] / "trajectory.txt")
    assert len(trajectory) == len(room_poses) - START
    for pose, truth in zip(trajectory.poses, room_poses[START:], strict=True):
        assert np.linalg.norm((inverse(truth) @ pose)[:3, 3]) < 0.012


def test_the_map_stays_the_same_one_and_grows(second, stored):
    before, after = MapStore(stored).manifest(), second.report["out"] / "map.meslam"
    manifest = MapStore(after).manifest()
    assert manifest.map_id == before.map_id
    assert {entry.index for entry in manifest.regions} >= {(0, 0, 0), FAR}
    assert second.report["keyframes"] >= 1


def test_a_region_that_was_not_visited_stays_as_it_is_to_the_bit(second, stored):
    def checksum(path: Path) -> str:
        return {e.index: e.sha256 for e in MapStore(path).manifest().regions}[FAR]

    assert checksum(second.report["out"] / "map.meslam") == checksum(stored)


def test_what_only_the_first_session_saw_is_not_forgotten(second, stored, room_frames, room_poses):
    frame, pose = room_frames[0], room_poses[0]
    points = frame.camera.back_project(frame.depth_m)[5:115:4, 5:155:4].reshape(-1, 3)
    points = points @ pose[:3, :3].T + pose[:3, 3]
    errors = [
        np.abs(NeuralMap.load(path).signed_distance_m(points))
        for path in (stored, second.report["out"] / "map.meslam")
    ]
    assert np.isfinite(errors[1]).mean() > 0.95
    assert np.nanmedian(errors[1]) < np.nanmedian(errors[0]) + 0.005


def test_localising_finds_poses_and_leaves_the_map_as_it_is(
    stored, quick_config, room_frames, room_poses, tmp_path, caplog
):
    beside = room_poses[START] @ exp(np.array([0.01, 0.0, 0.005, 0.0, 0.017, 0.0]))
    continuation = replace(Continuation.read(stored, beside), train=False)
    options = RunOptions(continuation=continuation)
    run(MemoryRecording(room_frames[START:]), quick_config, tmp_path, options)
    assert "does not confirm" not in caplog.text
    trajectory = read_tum(tmp_path / "trajectory.txt")
    assert len(trajectory) == len(room_poses) - START
    for pose, truth in zip(trajectory.poses, room_poses[START:], strict=True):
        assert np.linalg.norm((inverse(truth) @ pose)[:3, 3]) < 0.012
    before, after = (MapStore(p).manifest().regions for p in (stored, tmp_path / "map.meslam"))
    assert {e.sha256 for e in before} == {e.sha256 for e in after}


def test_localising_follows_the_camera_from_region_to_region(stored, quick_config, tmp_path):
    loaded = MapStore(stored).load()
    regions = [replace(loaded.regions[0], version=1)]
    T_map_beside = regions[0].T_map_region.copy()
    T_map_beside[:3, 3] = loaded.grid.center((1, 0, 0))
    regions.append(replace(regions[0], index=(1, 0, 0), T_map_region=T_map_beside))
    MapStore(tmp_path / "map.meslam").save(regions, loaded.grid, "two")
    continuation = replace(Continuation.read(tmp_path / "map.meslam", T_BODY_OPTICAL), train=False)
    atlas = Slam(quick_config, continuation=continuation).atlas
    middle = 0.5 * (loaded.grid.center((0, 0, 0)) + loaded.grid.center((1, 0, 0)))
    forward = np.array([0.2, 0.0, 0.0])
    assert atlas.working.index == (0, 0, 0)
    assert not atlas.follow(middle)
    assert atlas.follow(middle + forward)
    assert atlas.working.index == (1, 0, 0)
    assert atlas.regions[(0, 0, 0)].at_rest
    assert not atlas.follow(middle + 20 * forward), "where no region is, the last one works on"
    assert atlas.follow(middle - forward)
    assert set(atlas.regions) == {(0, 0, 0), (1, 0, 0)}


def test_remembered_views_lie_on_the_surface(stored, quick_config):
    continuation = Continuation.read(stored, np.eye(4))
    config = continuation.adapted(quick_config)
    region = _awake(*continuation.regions[0], config.field)
    views = list(remembered_views(region, 6, 500, np.random.default_rng(0)))
    assert len(views) == 6
    neural_map = NeuralMap([continuation.regions[0][0]])
    everywhere = []
    for pose, rays in views:
        ends = rays.directions.numpy() * rays.distances_m.numpy()[:, None]
        points = ends @ pose[:3, :3].T + pose[:3, 3]
        distance = np.abs(neural_map.signed_distance_m(points))
        assert np.nanmedian(distance) < 0.005
        assert np.all((rays.colors.numpy() >= 0) & (rays.colors.numpy() <= 1))
        everywhere.append(points)
    assert np.median(surface_distance_m(np.concatenate(everywhere))) < 0.03


def test_a_start_that_contradicts_the_map_is_told_and_spoils_nothing(
    stored, quick_config, room_frames, room_poses, tmp_path, caplog
):
    wrong = room_poses[START] @ exp(np.array([0.0, 0.0, 0.4, 0.0, 0.5, 0.0]))
    options = RunOptions(continuation=Continuation.read(stored, wrong))
    run(MemoryRecording(room_frames[START : START + 3]), quick_config, tmp_path, options)
    before, after = (MapStore(p).manifest().regions for p in (stored, tmp_path / "map.meslam"))
    assert {e.sha256 for e in before} == {e.sha256 for e in after}
    assert "does not confirm where the first image was taken" in caplog.text


def test_a_damaged_map_is_not_continued(stored, tmp_path):
    copy = tmp_path / "map.meslam"
    copy.mkdir()
    for file in stored.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    damaged = next(file for file in copy.iterdir() if file.name != "manifest.json")
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(MapError, match="cannot be continued"):
        Continuation.read(copy, np.eye(4))


def test_a_start_pose_is_text_or_the_first_line_of_a_file(finished_run, tmp_path):
    pose = exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])) @ T_BODY_OPTICAL
    text = " ".join(str(value) for value in (*pose[:3, 3], *to_quaternion(pose)))
    np.testing.assert_allclose(read_start_pose(text), pose, atol=1e-9)
    trajectory = read_tum(finished_run.truth)
    write_tum(tmp_path / "start.txt", trajectory)
    np.testing.assert_allclose(
        read_start_pose(str(tmp_path / "start.txt")), trajectory.poses[0], atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "neither"),
        ("1 2 3 0 0 0 x", "no number"),
        ("1 2 3 0 0 0 0", "unit quaternion"),
        ("1 2 nan 0 0 0 1", "finite"),
    ],
)
def test_a_start_pose_that_is_none_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        read_start_pose(text)


def test_map_and_start_pose_belong_together(stored):
    assert read_continuation(None, "") is None
    for path, pose in ((stored, ""), (None, "0 0 0 0 0 0 1")):
        with pytest.raises(ConfigError, match="give both"):
            read_continuation(path, pose)
