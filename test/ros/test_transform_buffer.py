from __future__ import annotations

import numpy as np
import pytest
from tf2_msgs.msg import TFMessage

from meslam_core.errors import FrameError
from meslam_core.se3 import exp, interpolate, inverse
from meslam_ros import topics, transform_buffer
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, to_stamp, to_transform
from meslam_ros.qos import STREAM
from meslam_ros.transform_buffer import TransformBuffer
from meslam_ros.transforms import StaticBroadcaster

WAIT_S = 10.0
T_MAP_ODOM = exp(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
T_BASE_CAMERA = exp(np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0]))


def T_odom_base(second: float) -> np.ndarray:
    return exp(second * np.array([0.5, 0.1, 0.0, 0.0, 0.0, 0.2]))


@pytest.fixture
def buffer(client: MeslamClient, monkeypatch: pytest.MonkeyPatch) -> TransformBuffer:
    """Ten seconds of a robot that drives."""
    # The test's only thread is the executor's.
    monkeypatch.setattr(transform_buffer, "PATIENCE_S", 0.0)
    buffer = TransformBuffer(client.node)
    publisher = client.node.create_publisher(TFMessage, topics.TF, STREAM)
    client.static = StaticBroadcaster(client.node, T_BASE_CAMERA, "base", "camera")
    with pytest.raises(FrameError):
        buffer.lookup("map", "camera")
    assert client.spin_until(lambda: publisher.get_subscription_count() > 0, WAIT_S)
    for second in range(10):
        stamp = to_stamp(second * NANOSECONDS + 1)
        publisher.publish(
            TFMessage(
                transforms=[
                    to_transform(T_MAP_ODOM, stamp, "map", "odom"),
                    to_transform(T_odom_base(second), stamp, "odom", "base"),
                ]
            )
        )

    def complete() -> bool:
        try:
            buffer.lookup("map", "camera", 9 * NANOSECONDS + 1)
        except FrameError:
            return False
        return True

    assert client.spin_until(complete, WAIT_S)
    return buffer


def test_chain_is_followed_in_both_directions(buffer: TransformBuffer) -> None:
    expected = T_MAP_ODOM @ T_odom_base(4) @ T_BASE_CAMERA
    stamp = 4 * NANOSECONDS + 1
    np.testing.assert_allclose(buffer.lookup("map", "camera", stamp), expected, atol=1e-9)
    np.testing.assert_allclose(buffer.lookup("camera", "map", stamp), inverse(expected), atol=1e-9)
    np.testing.assert_array_equal(buffer.lookup("map", "map"), np.eye(4))


def test_time_is_interpolated_and_the_latest_is_the_default(buffer: TransformBuffer) -> None:
    between = buffer.lookup("odom", "base", 3 * NANOSECONDS + NANOSECONDS // 2 + 1)
    expected = interpolate(T_odom_base(3), T_odom_base(4), 0.5)
    np.testing.assert_allclose(between, expected, atol=1e-9)
    np.testing.assert_allclose(buffer.lookup("odom", "base"), T_odom_base(9), atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "stamp", "words"),
    [
        ("elsewhere", 0, ("elsewhere", "camera", "odom")),
        ("camera", 60 * NANOSECONDS, ("60.000", "9.000")),
    ],
)
def test_unknown_frames_and_times_are_named(
    buffer: TransformBuffer, frame: str, stamp: int, words: tuple[str, ...]
) -> None:
    with pytest.raises(FrameError) as error:
        buffer.lookup("map", frame, stamp)
    assert all(word in str(error.value) for word in words)


def test_frames_without_end_cost_no_memory(
    buffer: TransformBuffer, client: MeslamClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transform_buffer, "MAX_FRAMES", 3)
    publisher = client.node.create_publisher(TFMessage, topics.TF, STREAM)
    assert client.spin_until(lambda: publisher.get_subscription_count() > 0, WAIT_S)
    stamp = to_stamp(20 * NANOSECONDS)
    publisher.publish(
        TFMessage(
            transforms=[
                to_transform(np.eye(4), stamp, "base", "one_too_many"),
                to_transform(T_odom_base(9.5), stamp, "odom", "base"),
            ]
        )
    )

    def moved_on() -> bool:
        return np.allclose(buffer.lookup("odom", "base"), T_odom_base(9.5), atol=1e-9)

    assert client.spin_until(moved_on, WAIT_S)
    with pytest.raises(FrameError, match="one_too_many"):
        buffer.lookup("base", "one_too_many")
