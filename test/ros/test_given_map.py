"""Tracking in a stored map, as the map server's load_map asks for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.room_camera import ANSWER_S, FAST, POSES, Camera

from meslam_core.se3 import exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_interfaces.srv import UseMap
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, to_pose
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import latched
from meslam_ros.region_messages import region_model, stored_region
from meslam_ros.tracking_node import TrackingNode

Code = UseMap.Response
START = 6


def true_base(number: int) -> np.ndarray:
    return POSES[number] @ inverse(T_BODY_OPTICAL)


class Models:
    """The newest model of each region, as anybody gets them."""

    def __init__(self, client: MeslamClient) -> None:
        self.latest: dict[tuple, RegionModel] = {}
        client.node.create_subscription(RegionModel, topics.REGION_MODELS, self._take, latched(100))

    def _take(self, model: RegionModel) -> None:
        self.latest[model.map_id, *map(int, model.index)] = model

    def of(self, map_id: str) -> list[RegionModel]:
        return [model for key, model in self.latest.items() if key[0] == map_id]


@pytest.fixture
def system(start_node, client):
    """Odometry and tracking that have mapped a part of the room, and a camera."""
    start_node(OdometryNode)
    tracking = start_node(TrackingNode, **FAST)
    models = Models(client)
    camera = Camera(client)
    camera.wait(nodes=2)
    for number in range(START):
        status = camera.track(number)
    assert client.spin_until(lambda: client.settled and bool(models.of(status.map_id)), ANSWER_S)
    return tracking, camera, models, status.map_id


def request(models: list[RegionModel], mode: int, **fields) -> UseMap.Request:
    """A request to track in the map of these models, renamed to one that was stored earlier."""
    for model in models:
        model.map_id = "stored"
    side_m = models[0].size_m.x
    center = models[0].pose.position
    result = UseMap.Request(
        mode=mode, map_id="stored", regions=models, lattice_side_m=side_m, overlap=0.2, **fields
    )
    result.lattice_origin.x, result.lattice_origin.y = center.x, center.y
    result.lattice_origin.z = center.z
    return result


def use(client: MeslamClient, asked: UseMap.Request) -> UseMap.Response:
    return client.call(UseMap, topics.USE_MAP, asked)


def track_in(camera: Camera, client: MeslamClient, map_id: str, number: int) -> TrackingStatus:
    """Show the same view until tracking has gone over to a map."""
    for repeated in range(200):
        status = camera.track(number, later_ns=(repeated + 1) * 1_000_000)
        if status.map_id == map_id:
            return status
    raise AssertionError(f"tracking stays in {client.statuses[-1].map_id}")


def start_pose(number: int) -> dict:
    """A start that is a centimetre and a degree beside the truth."""
    beside = true_base(number) @ exp(np.array([0.01, 0.0, 0.005, 0.0, 0.017, 0.0]))
    return {"use_start_pose": True, "start_pose": to_pose(beside)}


def pose_errors(client: MeslamClient, after_ns: int) -> list[float]:
    errors = []
    for stamp, T_map_base in client.poses.items():
        if stamp > after_ns:
            number = round((stamp - NANOSECONDS) / 66_666_667)
            errors.append(np.linalg.norm((inverse(true_base(number)) @ T_map_base)[:3, 3]))
    return errors


@pytest.mark.parametrize("mode", [UseMap.Request.CONTINUE, UseMap.Request.LOCALISE])
def test_tracking_goes_over_to_a_stored_map(system, client, mode) -> None:
    _, camera, models, first_id = system
    before = models.of(first_id)
    versions = {tuple(model.index): model.version for model in before}
    answer = use(client, request(before, mode, **start_pose(START)))
    assert answer.result == Code.SUCCESS, answer.message
    status = track_in(camera, client, "stored", START)
    gone_over_ns = client.last_stamp_ns
    for number in range(START + 1, len(POSES)):
        status = camera.track(number)
        assert status.state == TrackingStatus.OK, status.reason
        assert status.localising == (mode == UseMap.Request.LOCALISE)
    errors = pose_errors(client, gone_over_ns)
    assert len(errors) == len(POSES) - START - 1
    assert max(errors) < 0.015
    assert client.spin_until(lambda: client.settled and bool(models.of("stored")), ANSWER_S)
    after = {tuple(model.index): model.version for model in models.of("stored")}
    if mode == UseMap.Request.LOCALISE:
        assert after == versions
    else:
        assert all(after[index] >= version for index, version in versions.items())
        assert after != versions


def test_without_a_start_the_same_map_goes_on_where_the_camera_is(system, client) -> None:
    _, camera, models, first_id = system
    asked = request(models.of(first_id), UseMap.Request.LOCALISE)
    for model in asked.regions:
        model.map_id = first_id
    asked.map_id = first_id
    answer = use(client, asked)
    assert answer.result == Code.SUCCESS, answer.message
    for repeated in range(200):
        if camera.track(START, later_ns=(repeated + 1) * 1_000_000).localising:
            break
    gone_over_ns = client.last_stamp_ns
    status = camera.track(START + 1)
    assert status.localising
    assert status.state == TrackingStatus.OK
    assert max(pose_errors(client, gone_over_ns)) < 0.015


def test_a_recording_that_starts_again_is_localised_again(system, client) -> None:
    _, camera, models, first_id = system
    asked = request(models.of(first_id), UseMap.Request.LOCALISE, **start_pose(START))
    assert use(client, asked).result == Code.SUCCESS
    track_in(camera, client, "stored", START)
    for number in (START, START + 1):
        status = camera.track(number, later_ns=10 * NANOSECONDS)
    assert status.localising
    before = len(client.poses)
    for number in range(START - 5, START + 1):
        status = camera.track(number)
    assert (status.map_id, status.localising) == ("stored", True)
    assert status.frames_tracked == 1
    assert status.state == TrackingStatus.OK
    assert client.spin_until(lambda: len(client.poses) > before, ANSWER_S)


def damaged(asked: UseMap.Request, how: str) -> UseMap.Request:
    if how == "mode":
        asked.mode = 7
    elif how == "pose":
        asked.use_start_pose = True
        asked.start_pose.position.x = float("nan")
    elif how == "empty":
        asked.regions = []
    elif how == "bytes":
        asked.regions[0].data[100] ^= 1
    elif how == "identity":
        asked.map_id = "another"
    elif how == "lattice":
        asked.lattice_side_m = -1.0
    elif how == "overlap":
        asked.overlap = float("nan")
    elif how == "twice":
        asked.regions = [*asked.regions, *asked.regions]
    elif how == "networks":
        region = stored_region(asked.regions[0])
        other = replace(
            region,
            index=(1, 0, 0),
            mask=region.mask.from_flags(
                region.mask.flags[:-2, :-2, :-2].copy(), region.mask.voxel_m
            ),
        )
        asked.regions = [*asked.regions, region_model(other, "stored", "map", "int8")]
    return asked


CASES = {
    "mode": (Code.INVALID_REQUEST, "LOCALISE is 2"),
    "pose": (Code.INVALID_REQUEST, "nan"),
    "empty": (Code.INVALID_DATA, "no region"),
    "bytes": (Code.INVALID_DATA, "checksum"),
    "identity": (Code.INVALID_DATA, "is of the map"),
    "lattice": (Code.INVALID_DATA, "lattice"),
    "overlap": (Code.INVALID_DATA, "lattice"),
    "twice": (Code.INVALID_DATA, "2 regions have 1 places"),
    "networks": (Code.INVALID_DATA, "different networks or masks"),
}


def test_what_cannot_be_tracked_in_is_refused_and_tracking_goes_on(system, client) -> None:
    _, camera, models, first_id = system
    (region,) = models.of(first_id)
    for how, (code, word) in CASES.items():
        copy = region_model(stored_region(region), "stored", "map", "int8")
        answer = use(client, damaged(request([copy], 1), how))
        assert (answer.result, word in answer.message) == (code, True), (how, answer.message)
    status = camera.track(START)
    assert (status.map_id, status.state) == (first_id, TrackingStatus.OK)
