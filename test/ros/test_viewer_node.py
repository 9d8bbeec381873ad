"""The live page: real messages in, and a real browser that follows them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import nav_msgs.msg
import numpy as np
import pytest
from data.analytic_scene import SphereInRoom, learnt_field, stored
from data.browser import WORKING, count, open_browser, open_page, screenshot, wait_for_text
from data.map_client import model, publish
from geometry_msgs.msg import PoseStamped
from playwright.sync_api import Page
from sensor_msgs.msg import CameraInfo, Image

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.map.stored_region import StoredRegion
from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import camera_to_info, color_message, to_pose, to_stamp
from meslam_ros.processes import NodeProcess, ros_arguments
from meslam_ros.qos import STREAM, images, latched
from meslam_ros.transforms import StaticBroadcaster

WAIT_S = 120.0
BALL, IMAGE = (230, 26, 26), (200, 40, 200)
MANY, SOME = 300, 40
CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
BODY_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class Tracker:
    """Says what tracking says."""

    def __init__(self, client: MeslamClient) -> None:
        create = client.node.create_publisher
        self._status = create(TrackingStatus, topics.STATUS, STREAM)
        self._pose = create(PoseStamped, topics.POSE, STREAM)
        self._info = create(CameraInfo, topics.COLOR_INFO, images(STREAM.reliability))
        self._image = create(Image, topics.COLOR, images(STREAM.reliability))
        self._mount = StaticBroadcaster(client.node, BODY_OPTICAL, "camera_link", "optical")
        self._path = create(nav_msgs.msg.Path, topics.PATH, latched())
        self.frames = 0

    def mislead(self) -> None:
        """What no tracking says, and somebody else may."""
        nowhere = PoseStamped()
        nowhere.pose.position.x = float("nan")
        self._path.publish(nav_msgs.msg.Path(poses=[nowhere]))
        self._info.publish(CameraInfo())

    def track(self, y: float = 0.0, **status: object) -> None:
        """One frame at a place beside the ball."""
        self.frames += 1
        stamp = to_stamp(self.frames * 50_000_000)
        pixels = np.full((CAMERA.height, CAMERA.width, 3), IMAGE, np.uint8)
        self._info.publish(camera_to_info(CAMERA, stamp, "optical"))
        self._image.publish(color_message(pixels, stamp, "optical"))
        pose = PoseStamped(pose=to_pose(se3.exp(np.array([-1.1, y, 0.0, 0.0, 0.0, 0.0]))))
        self._pose.publish(pose)
        told = {"state": TrackingStatus.OK, "map_id": "first", "latency_s": 0.04} | status
        self._status.publish(
            TrackingStatus(frames_tracked=self.frames, frames_received=self.frames, **told)
        )


@pytest.fixture(scope="module")
def region() -> StoredRegion:
    return stored(learnt_field(), SphereInRoom())


@pytest.fixture
def viewer(client: MeslamClient, region: StoredRegion, tmp_path: Path) -> Iterator[NodeProcess]:
    """A node that starts after the first region was published."""
    publish(client, model(region))
    parameters = {"port": 0, "mesh_resolution_m": 0.08}
    node = NodeProcess("viewer_node", ros_arguments(parameters), log=tmp_path / "viewer.log")
    yield node
    assert node.stop() == 0, node.output()


@pytest.fixture
def page(viewer: NodeProcess, client: MeslamClient) -> Iterator[Page]:
    assert client.spin_until(lambda: "shown on http" in viewer.output(), WAIT_S), viewer.output()
    url = next(word for word in viewer.output().split() if word.startswith("http"))
    with open_browser() as browser:
        yield open_page(browser, url)


def until(client: MeslamClient, act: Callable[[], None], holds: Callable[[], bool]) -> None:
    """Do something again and again until something holds."""

    def done() -> bool:
        act()
        return holds()

    assert client.spin_until(done, WAIT_S)


def test_the_page_follows_a_running_system(client, page: Page, region: StoredRegion) -> None:
    wait_for_text(page, "WAITING")
    wait_for_text(page, topics.STATUS)
    tracker = Tracker(client)
    until(client, tracker.track, lambda: count(screenshot(page), BALL) > MANY)
    spoilt = [model(replace(region, index=(9, 0, 0))) for _ in range(2)]
    spoilt[0].data[100] ^= 1
    spoilt[1].size_m.x = -1.0
    publish(client, *spoilt)
    tracker.mislead()
    until(client, tracker.track, lambda: count(screenshot(page), IMAGE, 12) > MANY)
    working = count(screenshot(page), WORKING, 12)
    assert working > SOME
    wait_for_text(page, "bytes/m³")
    # The camera works elsewhere, and is lost there.
    lost = {"state": TrackingStatus.LOST, "reason": "nothing is recognised", "latency_s": 0.0}
    until(
        client,
        lambda: tracker.track(0.5, working_region=[5, 5, 5], **lost),
        lambda: "nothing is recognised" in page.inner_text("body"),
    )
    wait_for_text(page, "LOST")
    until(client, lambda: None, lambda: count(screenshot(page), WORKING, 12) < 0.5 * working)
    # Another map: nothing of this one is left, and its regions come.
    until(
        client,
        lambda: tracker.track(map_id="second"),
        lambda: count(screenshot(page), BALL) < SOME,
    )
    publish(client, model(replace(region, version=2), "second"))
    until(
        client,
        lambda: tracker.track(map_id="second"),
        lambda: count(screenshot(page), BALL) > MANY,
    )
