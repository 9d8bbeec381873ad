"""The whole system over real DDS: a recording in, poses, regions, a mesh and a map out."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import pytest
from data import ros_domain
from data.live_system import LiveRun, run_live

from meslam_core.camera import PinholeCamera
from meslam_core.evaluation.reconstruction import observed_surface, surface_error
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.recordings import convert
from meslam_core.simulation.simulator import Simulation, simulate
from meslam_interfaces.msg import Region, TrackingStatus
from meslam_interfaces.srv import QueryOccupancy
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import stamp_ns

ros_domain.enter()

CAMERA = PinholeCamera(320, 240, 307.5, 307.5, 159.5, 119.5)
DURATION_S = 4.0
ANSWERED: dict[str, np.ndarray] = {}
POINTS = np.random.default_rng(0).uniform([0, -1.5, -1], [3, 1.5, 1], (4000, 3)).astype("f4")


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate("room", DURATION_S, seed=3, camera=CAMERA)


@pytest.fixture(scope="module")
def live(simulation: Simulation, tmp_path_factory: pytest.TempPathFactory) -> LiveRun:
    folder = tmp_path_factory.mktemp("live")
    recording = folder / "room.mcap"
    convert(simulation, recording)

    def query(client: MeslamClient) -> None:
        request = QueryOccupancy.Request(points=POINTS.reshape(-1).tolist())
        answer = client.call(QueryOccupancy, topics.QUERY_OCCUPANCY, request)
        assert answer.result == answer.SUCCESS, answer.message
        ANSWERED["occupancy"] = np.array(answer.occupancy)

    return run_live(recording, folder, use=query)


def test_every_frame_gets_a_pose(live: LiveRun, simulation: Simulation) -> None:
    assert len({stamp_ns(status.header.stamp) for status in live.statuses}) == len(simulation)
    assert live.statuses[-1].frames_dropped == 0
    np.testing.assert_array_equal(live.online.stamps_ns, simulation.stamps_ns)
    np.testing.assert_array_equal(live.refined.stamps_ns, simulation.stamps_ns)
    states = [status.state for status in live.statuses]
    assert states.count(TrackingStatus.OK) >= 0.98 * len(simulation)
    assert "Traceback" not in live.logs


def test_trajectory_is_the_true_one(live: LiveRun, simulation: Simulation) -> None:
    assert absolute_error(live.online, simulation.truth).rmse_m < 0.04
    assert absolute_error(live.refined, simulation.truth).rmse_m < 0.04


def test_map_frame_is_where_the_base_began(live: LiveRun) -> None:
    first = live.online.poses[0]
    np.testing.assert_allclose(first[:3, 3], 0.0, atol=1e-6)
    np.testing.assert_allclose(first[:3, 2], [1.0, 0.0, 0.0], atol=1e-6)


def test_regions_are_announced_with_the_working_one(live: LiveRun) -> None:
    array = live.regions
    assert array.header.frame_id == "map"
    assert array.map_id == live.statuses[-1].map_id
    assert array.regions[array.working].state == Region.WORKING
    assert list(array.regions[array.working].index) == list(live.statuses[-1].working_region)
    assert sum(region.observed_volume_m3 for region in array.regions) > 1.0
    assert sum(region.keyframes for region in array.regions) >= live.statuses[-1].keyframes


def test_exported_mesh_is_the_simulators_surface(live: LiveRun, simulation: Simulation) -> None:
    assert live.export.result == live.export.SUCCESS, live.export.message
    mesh = o3d.io.read_triangle_mesh(live.export.path)
    assert mesh.has_vertex_colors()
    assert np.ptp(np.asarray(mesh.vertex_colors), axis=0).min() > 0.2
    T_truth_map = absolute_error(live.refined, simulation.truth).mounting.T_truth_map
    observed = observed_surface(simulation.surface, CAMERA, simulation.truth, farthest_m=3.0)
    error = surface_error(mesh, simulation.surface, observed, T_truth_map=T_truth_map)
    assert error.accuracy_median_m < 0.025
    assert error.completion_ratio > 0.85


def test_saved_map_answers_as_the_server_did(live: LiveRun) -> None:
    assert live.saved.result == live.saved.SUCCESS, live.saved.message
    loaded = MapStore(live.saved.path).load()
    assert not loaded.warnings
    assert loaded.map_id == live.statuses[-1].map_id
    occupancy, _ = NeuralMap(loaded.regions).occupancy(POINTS)
    np.testing.assert_array_equal(occupancy, ANSWERED["occupancy"])
    assert {-1, 0, 100} == set(np.unique(occupancy))
