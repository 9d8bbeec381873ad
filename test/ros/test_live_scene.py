"""What the viewer makes of single messages, without a node around it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
import pytest
from data.synthetic_frames import CAMERA
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import CameraInfo

from meslam_core.errors import FrameError, MapError
from meslam_core.viewer.scene import RegionState, Scene
from meslam_interfaces.msg import RegionIndex, RegionModel, TrackingStatus
from meslam_ros import live_scene
from meslam_ros.conversions import camera_to_info, to_pose, to_stamp
from meslam_ros.live_scene import LiveScene


@dataclass
class Background:
    """Notes what it is given."""

    taken: list[tuple[tuple[int, int, int], int, bytes]] = field(default_factory=list)
    maps: int = 0

    def begin(self) -> None:
        self.maps += 1

    def take(self, index: tuple[int, int, int], version: int, data: bytes) -> None:
        self.taken.append((index, version, data))


@dataclass
class Live:
    scene: Scene = field(default_factory=Scene)
    background: Background = field(default_factory=Background)
    mount: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.messages = LiveScene(self.scene, self.background, lambda frame: self.mount)


def model(index=(0, 0, 0), version: int = 1, map_id: str = "a") -> RegionModel:
    message = RegionModel(
        map_id=map_id, index=np.array(index, np.int32), version=version, keyframes=4
    )
    message.size_m.x, message.observed_volume_m3, message.data = 3.0, 5.0, [1, 2, 3]
    message.format = RegionModel.FORMAT
    message.sha256 = hashlib.sha256(message.data).hexdigest()
    message.pose.orientation.w = 1.0
    return message


def status(**fields) -> TrackingStatus:
    return TrackingStatus(**{"map_id": "a", "state": TrackingStatus.OK} | fields)


def pose(x: float) -> PoseStamped:
    T = np.eye(4)
    T[0, 3] = x
    return PoseStamped(pose=to_pose(T))


def test_models_become_boxes_and_go_to_the_background_once() -> None:
    live = Live()
    for message in (model(), model(), model((1, 0, 0)), model(version=2)):
        live.messages.take_model(message)
    assert [(index, version) for index, version, _ in live.background.taken] == [
        ((0, 0, 0), 1),
        ((1, 0, 0), 1),
        ((0, 0, 0), 2),
    ]
    live.messages.take_status(
        status(
            working_region=np.array([1, 0, 0], np.int32),
            training_regions=[RegionIndex(index=np.zeros(3, np.int32))],
        )
    )
    states = {box.index: box.state for box in live.scene.regions.value}
    assert states == {(0, 0, 0): RegionState.TRAINING, (1, 0, 0): RegionState.WORKING}
    shown = live.scene.status.value
    assert (shown.state, shown.map_bytes, shown.observed_volume_m3) == ("OK", 6, 10.0)


def test_another_map_leaves_nothing_of_the_one_before() -> None:
    live = Live()
    live.messages.take_status(status())
    live.messages.take_model(model())
    live.messages.take_pose(pose(1.0))
    live.messages.take_status(status(map_id="b"))
    assert live.background.maps == 2
    assert live.scene.regions.value == ()
    assert len(live.scene.online_path.value) == 0
    live.messages.take_model(model(version=9))
    assert live.scene.regions.value == (), "of the map before"


def test_poses_are_those_of_the_camera_and_rest_is_not_path() -> None:
    live = Live()
    live.messages.take_info(camera_to_info(CAMERA, to_stamp(0), "optical"))
    for x in (0.0, 0.001, 0.1, 0.2):
        live.messages.take_pose(pose(x))
    view = live.scene.camera.value
    assert view is not None
    assert np.allclose(view.T_map_camera[:3, 2], [1.0, 0.0, 0.0]), "ahead, before /tf_static"
    assert view.aspect == pytest.approx(CAMERA.width / CAMERA.height)
    assert np.allclose(live.scene.online_path.value[:, 0], [0.0, 0.1, 0.2])
    live.mount = np.eye(4)
    live.mount[1, 3] = 0.5
    live.messages.take_pose(pose(0.3))
    assert np.allclose(live.scene.camera.value.T_map_camera[:3, 3], [0.3, 0.5, 0.0])
    live.messages.take_path(Path(poses=[pose(0.0), pose(0.4)]))
    assert np.allclose(live.scene.refined_path.value, [[0.0, 0.5, 0.0], [0.4, 0.5, 0.0]])


def test_nonsense_is_refused_and_changes_nothing() -> None:
    live = Live()
    live.messages.take_model(model())
    spoilt = [model((1, 0, 0), map_id=map_id) for map_id in ("a", "b", "b")]
    spoilt[0].data[0] = 9
    spoilt[1].size_m.x = -1.0
    spoilt[2].pose.position.x = float("nan")
    for message in spoilt:
        with pytest.raises(MapError, match=r"region \[1, 0, 0\]"):
            live.messages.take_model(message)
    nowhere = PoseStamped()
    nowhere.pose.position.z = float("inf")
    for take, message in (
        (live.messages.take_pose, nowhere),
        (live.messages.take_path, Path(poses=[pose(0.0), nowhere])),
        (live.messages.take_info, CameraInfo()),
    ):
        with pytest.raises(FrameError):
            take(message)
    assert [box.index for box in live.scene.regions.value] == [(0, 0, 0)]
    assert live.background.maps == 1
    assert live.scene.camera.value is None
    assert not len(live.scene.refined_path.value)


def test_what_it_waits_for_and_silence_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live()
    assert "meslam/status" in live.scene.status.value.reason
    assert not live.messages.begun
    now = 100.0
    monkeypatch.setattr(live_scene.time, "monotonic", lambda: now)
    for _ in range(11):
        live.messages.take_status(status(latency_s=0.05))
        now += 0.1
    shown = live.scene.status.value
    assert shown.frames_per_s == pytest.approx(10.0)
    assert shown.latency_ms == pytest.approx(50.0)
    now += 7.0
    live.messages.notice_silence()
    assert live.scene.status.value.frames_per_s == 0.0
    assert "7 s" in live.scene.status.value.reason
