"""The hand-held path of each scene."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from meslam_core.config import RegionsConfig
from meslam_core.regions.grid import RegionGrid
from meslam_core.se3 import inverse
from meslam_core.simulation.path import HandheldPath, Route, looking_ahead
from meslam_core.simulation.renderer import scene_surface
from meslam_core.simulation.scenes import SCENES, build_scene

FPS = 15
BODY_AXES = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
"""Turns optical axes into x forward, y left, z up: the map's axes at the first pose."""

scene = lru_cache(build_scene)


@lru_cache
def caster(name: str) -> o3d.t.geometry.RaycastingScene:
    result = o3d.t.geometry.RaycastingScene()
    result.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(scene_surface(scene(name))))
    return result


def walked(route: Route, duration_s: float, seed: int = 0) -> np.ndarray:
    path = HandheldPath(route, duration_s, seed)
    return np.stack([path.pose(i / FPS) for i in range(round(duration_s * FPS))])


def poses(duration_s: float, seed: int = 0, name: str = "room") -> np.ndarray:
    return walked(scene(name).route, duration_s, seed)


def one_round(name: str, seed: int = 0) -> np.ndarray:
    return poses(scene(name).route.round_s, seed, name)


def length_m(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).sum())


def speeds_and_rates(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres and degrees a second between consecutive poses."""
    speeds = FPS * np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    turns = Rotation.from_matrix(path[:-1, :3, :3].transpose(0, 2, 1) @ path[1:, :3, :3])
    return speeds, FPS * np.degrees(turns.magnitude())


def regions_in_order(path: np.ndarray) -> list[tuple[int, int, int]]:
    """The region whose centre is nearest along a path, without repetitions."""
    positions = (inverse(path[0]) @ path)[:, :3, 3] @ BODY_AXES.T
    grid = RegionGrid.around(np.zeros(3), RegionsConfig())
    nearest = [grid.nearest(position) for position in positions]
    return [cell for i, cell in enumerate(nearest) if i == 0 or cell != nearest[i - 1]]


@pytest.mark.parametrize("duration_s", [20.0, 45.0])
def test_path_comes_back_to_its_start(duration_s):
    path = poses(duration_s)
    assert np.linalg.norm(path[-1, :3, 3] - path[0, :3, 3]) < 0.05
    turned = Rotation.from_matrix(path[0, :3, :3].T @ path[-1, :3, :3]).magnitude()
    assert np.degrees(turned) < 5


@pytest.mark.parametrize("name", sorted(SCENES))
def test_one_round_comes_back_to_its_start(name):
    path = one_round(name)
    assert np.linalg.norm(path[-1, :3, 3] - path[0, :3, 3]) < 0.05
    turned = Rotation.from_matrix(path[0, :3, :3].T @ path[-1, :3, :3]).magnitude()
    assert np.degrees(turned) < 5


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("duration_s", [4.0, 20.0])
def test_motion_is_that_of_a_hand(duration_s, seed):
    speeds, rates = speeds_and_rates(poses(duration_s, seed))
    assert 0.2 < np.median(speeds) < 0.4
    assert speeds.max() < 0.6
    assert rates.max() < 50


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("name", "slowest", "fastest"),
    [("building", 0.65, 0.80), ("corridor", 0.5, 0.7), ("library", 0.2, 0.45)],
)
def test_other_scenes_are_walked_steadily(name, slowest, fastest, seed):
    speeds, rates = speeds_and_rates(one_round(name, seed))
    assert slowest < np.median(speeds) < np.percentile(speeds, 99) < fastest
    assert rates.mean() < 30
    assert rates.max() < 65


def test_poses_are_rigid():
    rotations = poses(5.0)[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * 75, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_camera_keeps_off_surfaces_and_inside_the_first_region(seed):
    positions = poses(20.0, seed)[:, :3, 3]
    query = o3d.core.Tensor.from_numpy(positions.astype(np.float32))
    assert caster("room").compute_distance(query).numpy().min() > 0.4
    assert (np.abs(positions - positions[0]).max(axis=1) < 1.55).mean() > 0.95


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", sorted(SCENES))
def test_camera_never_touches_anything(name, seed):
    positions = one_round(name, seed)[:, :3, 3]
    query = o3d.core.Tensor.from_numpy(positions.astype(np.float32))
    # Doorways of a metre are the narrowest places.
    assert caster(name).compute_distance(query).numpy().min() > 0.25


@pytest.mark.parametrize("name", ["building", "corridor"])
def test_enough_of_what_the_camera_sees_is_within_its_range(name):
    """Everywhere on the way, and no wall ends where nothing is behind it."""
    rng = np.random.default_rng(0)
    in_view = np.stack([*rng.uniform(-1, 1, (2, 300)) * [[0.52], [0.39]], np.ones(300)], 1)
    for pose in one_round(name)[::30]:
        rays = np.concatenate([np.tile(pose[:3, 3], (300, 1)), in_view @ pose[:3, :3].T], 1).astype(
            np.float32
        )
        depth = caster(name).cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
        assert np.isfinite(depth).all()
        assert ((depth > 0.3) & (depth < 5.5)).mean() > 0.5


@pytest.mark.parametrize("seed", [0, 1])
def test_building_is_long_and_comes_back_to_its_first_regions(seed):
    path = one_round("building", seed)
    assert length_m(path) > 100
    visited = regions_in_order(path)
    assert len(set(visited)) >= 12
    first_return = visited.index(visited[0], 1)
    assert len(set(visited[1:first_return])) >= 10
    assert visited[-1] == visited[0]
    # The corridor is walked twice in the same direction.
    assert visited[first_return : first_return + 3] == visited[:3]


@pytest.mark.parametrize("duration_s", [30.0, 90.0, 150.0])
def test_library_is_two_regions_however_long_one_looks(duration_s):
    positions = poses(duration_s, name="library")
    assert set(regions_in_order(positions)) == {(0, 0, 0), (1, 0, 0)}


def test_library_is_seen_from_other_heights_and_angles_every_round():
    route = scene("library").route
    path = walked(route, 1 + 2 * (route.round_s - 1))
    first, second = np.array_split(path[15:-15], 2)
    other = min(len(first), len(second))
    difference = np.abs(first[:other] - second[:other]).max(axis=0)
    assert difference[2, 3] > 0.03
    assert difference[:3, 2].max() > 0.03


def test_a_route_is_not_hurried_to_end_where_it_began():
    route = scene("building").route
    unhurried = walked(route, 0.8 * route.round_s)
    assert np.median(speeds_and_rates(unhurried)[0]) < 0.80
    assert np.linalg.norm(unhurried[-1, :3, 3] - unhurried[0, :3, 3]) > 2
    slower = walked(route, 1.3 * route.round_s)
    assert np.linalg.norm(slower[-1, :3, 3] - slower[0, :3, 3]) < 0.05


def test_walker_looks_where_the_way_leads():
    corner = np.array([(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)], float)
    anchors = looking_ahead(corner, ahead_m=1.0)
    there = np.roll(anchors[:, :2], -1, axis=0) - anchors[:, :2]
    course = np.arctan2(there[:, 1], there[:, 0])
    ahead = (anchors[:, 3] - course + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees(np.abs(ahead)).max() < 40
    assert np.abs(np.diff(anchors[:, 3])).max() < 1.0
    glancing = looking_ahead(np.add(corner, (0, 0, 0.3)), ahead_m=1.0)
    np.testing.assert_allclose(glancing[:, 3], anchors[:, 3] + 0.3)
    assert anchors[0, 4] == 0


def test_seeds_differ_and_repeat():
    np.testing.assert_array_equal(poses(3.0, 1), poses(3.0, 1))
    assert np.abs(poses(3.0, 1) - poses(3.0, 2)).max() > 0.005
