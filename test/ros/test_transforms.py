from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import rclpy
from rclpy.node import Node

from meslam_core.errors import FrameError
from meslam_core.se3 import exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_ros.client import MeslamClient
from meslam_ros.transforms import BaseFrame, StaticBroadcaster, StaticTransforms

T_LINK_CAMERA = exp(np.array([0.0, 0.015, 0.0, 0.01, 0.0, 0.0]))
OPTICAL = "camera_color_optical_frame"


@pytest.fixture
def robot() -> Iterator[Node]:
    node = rclpy.create_node("robot")
    yield node
    node.destroy_node()


@pytest.fixture
def transforms(client: MeslamClient) -> StaticTransforms:
    return StaticTransforms(client.node)


def publish_camera(robot: Node) -> list[StaticBroadcaster]:
    return [
        StaticBroadcaster(robot, T_LINK_CAMERA, "camera_link", "camera_color_frame"),
        StaticBroadcaster(robot, T_BODY_OPTICAL, "camera_color_frame", OPTICAL),
    ]


def test_chain_of_a_driver_that_started_earlier_is_found(robot, client, transforms) -> None:
    kept = publish_camera(robot)
    assert client.spin_until(lambda: transforms.lookup("camera_link", OPTICAL) is not None, 5.0), (
        kept
    )
    found = transforms.lookup("camera_link", OPTICAL)
    np.testing.assert_allclose(found, T_LINK_CAMERA @ T_BODY_OPTICAL, atol=1e-12)
    np.testing.assert_allclose(
        transforms.lookup(OPTICAL, "camera_link"), inverse(found), atol=1e-12
    )
    assert transforms.lookup("camera_link", "elsewhere") is None


def test_root_is_the_topmost_parent(robot, client, transforms) -> None:
    kept = [
        *publish_camera(robot),
        StaticBroadcaster(robot, np.eye(4), "base_link", "camera_link"),
    ]
    assert client.spin_until(lambda: transforms.root(OPTICAL) == "base_link", 5.0), kept
    assert transforms.root("camera_link") == "base_link"
    assert transforms.root("base_link") == "base_link"
    assert transforms.root("unheard_of") == "unheard_of"


def test_base_is_the_wanted_frame_when_it_is_connected(robot, client, transforms) -> None:
    warnings: list[str] = []
    kept = publish_camera(robot)
    base = BaseFrame(transforms, "camera_link", 5.0, warnings.append)
    assert client.spin_until(lambda: base.resolve(OPTICAL) is not None, 5.0), kept
    mount = base.resolve(OPTICAL)
    assert mount is not None
    assert mount.base_frame == "camera_link"
    assert not mount.base_is_optical
    np.testing.assert_allclose(mount.T_base_optical, T_LINK_CAMERA @ T_BODY_OPTICAL, atol=1e-12)
    assert not warnings


def test_optical_frame_is_the_base_after_the_timeout_with_a_warning(client, transforms) -> None:
    warnings: list[str] = []
    base = BaseFrame(transforms, "camera_link", 0.2, warnings.append)
    assert base.resolve(OPTICAL) is None
    assert client.spin_until(lambda: base.resolve(OPTICAL) is not None, 5.0)
    mount = base.resolve(OPTICAL)
    assert mount is not None
    assert mount.base_is_optical
    np.testing.assert_array_equal(mount.T_base_optical, np.eye(4))
    (warning,) = warnings
    assert OPTICAL in warning
    assert "camera_link" in warning


def test_optical_frame_is_the_base_at_once_when_asked_for(transforms) -> None:
    warnings: list[str] = []
    mount = BaseFrame(transforms, "", 60.0, warnings.append).resolve(OPTICAL)
    assert mount is not None
    assert mount.base_is_optical
    assert not warnings


def test_images_without_a_frame_are_refused(transforms) -> None:
    with pytest.raises(FrameError, match="frame_id"):
        BaseFrame(transforms, "camera_link", 1.0, print).resolve("")
