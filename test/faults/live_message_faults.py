"""Messages about the map, the odometry and the frames that are damaged, malicious or wrong."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import zstandard
from data.ros_camera import BASE_FRAME, OPTICAL_FRAME
from faults.live_graph import LiveGraph
from faults.live_trial import STATES, Disturbance, live
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage

from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import byte_array
from meslam_ros.region_messages import region_model, stored_region

MAP_SIDE = ("map_server_node", "region_manager_node", "tracking_node")
TRACKING = ("tracking_node",)
COUNT = 3
REFUSED = "refused by name and counted by the map server, whose map stays as it is"
WITHOUT = "the image is tracked without odometry, the log says why"
NAN = float("nan")
BOMB_BYTES = 1 << 30
ALLOWED_GROWTH_KB = 200_000
# The middleware holds a message and its copies whole before anybody can refuse it.
LARGE_KB = 2 * 3 * 65 * 1024


def sealed(model: RegionModel, data: bytes) -> None:
    """Other data with the right checksum."""
    model.data, model.sha256 = byte_array(data), hashlib.sha256(data).hexdigest()


def flipped(model: RegionModel) -> None:
    model.data[len(model.data) // 2] ^= 0x10


def truncated(model: RegionModel) -> None:
    sealed(model, bytes(model.data)[: len(model.data) // 2])


def of_another_version(model: RegionModel) -> None:
    model.format = "meslam-region/9"


def too_large(model: RegionModel) -> None:
    sealed(model, bytes(65 << 20))


def bomb(model: RegionModel) -> None:
    """A valid header and a few kilobytes that become a gigabyte."""
    payload = zstandard.ZstdCompressor(level=1).compress(bytes(BOMB_BYTES))
    head = struct.pack("<8sIIQQ", b"MESLAMRG", 1, 0, len(payload), BOMB_BYTES)
    sealed(model, head + hashlib.sha256(head + payload).digest() + payload)


def at_another_place(model: RegionModel) -> None:
    model.index = np.array([7, 7, 7], np.int32)


def without_a_box(model: RegionModel) -> None:
    model.pose.position.x, model.size_m.x = NAN, -1.0


def model_refused(
    damage: Callable[[RegionModel], None], *words: str, received_kb: int = 0
) -> Disturbance:
    """The next version of a region, damaged, from somebody else on the network."""

    def disturb(graph: LiveGraph) -> str:
        map_id = graph.settle()
        known = stored_region(next(iter(graph.models.values())))
        newer = replace(known, version=known.version + 1)
        model = region_model(newer, map_id, "map", "int8")
        damage(model)
        before_kb = peak_memory_kb(graph)
        with graph.foreign(RegionModel, topics.REGION_MODELS, nodes=2) as publisher:
            for _ in range(COUNT):
                publisher.publish(model)
            seen = graph.reported("map_server_node", "region models refused", f": {COUNT}")
        graph.logged("map_server_node", "region model refused", *words)
        assert graph.served() == graph.published(map_id), "the map has changed"
        growth_kb = peak_memory_kb(graph) - before_kb
        assert growth_kb < ALLOWED_GROWTH_KB + received_kb, f"the map server took {growth_kb} kB"
        return f"{seen}; {words[0]!r} logged"

    return disturb


def peak_memory_kb(graph: LiveGraph) -> int:
    status = Path(f"/proc/{graph.processes['map_server_node'].pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0])


def known_again(graph: LiveGraph) -> str:
    """Region models that are known, in the wrong order and from two publishers."""
    map_id = graph.settle()
    with graph.foreign(RegionModel, topics.REGION_MODELS, nodes=2) as publisher:
        for _ in range(COUNT):
            for model in graph.models.values():
                publisher.publish(model)
            graph.wait(0.2)
    assert graph.served() == graph.published(map_id), "the map has changed"
    return "nothing has changed"


def wrong_odometry(change: Callable[[Odometry], None], *words: str) -> Disturbance:
    """Odometry of which some messages are wrong, among good ones."""

    def disturb(graph: LiveGraph) -> str:
        with graph.foreign(Odometry, topics.ODOMETRY) as wheels:

            def drive(wrong: bool = False) -> TrackingStatus:
                message = graph.odometry()
                if wrong:
                    change(message)
                wheels.publish(message)
                return graph.track()

            drive()
            assert drive().odometry_valid, "good odometry was not used"
            wrong = [drive(wrong=True) for _ in range(COUNT)]
            assert not any(status.odometry_valid for status in wrong), "wrong odometry was used"
            assert drive().map_id == wrong[0].map_id, "a new map was begun"
        log = graph.processes["tracking_node"].output()
        told = [word for word in words if word in log or word in wrong[-1].reason]
        assert told == list(words), f"not told: {set(words) - set(told)}"
        graph.track_well(1)
        return f"{STATES[wrong[-1].state]} without odometry"

    return disturb


def pose_of_nan(message: Odometry) -> None:
    message.pose.pose.position.x = NAN


def covariance_of_nan(message: Odometry) -> None:
    message.twist.covariance = np.full(36, NAN)


def no_rotation(message: Odometry) -> None:
    q = message.pose.pose.orientation
    q.x = q.y = q.z = q.w = 1e-200


def out_of_this_world(message: Odometry) -> None:
    message.pose.pose.position.y = 1e300


def scaled_quaternions(graph: LiveGraph) -> str:
    """A driver that does not normalise: the rotation is right all the same."""

    with graph.foreign(Odometry, topics.ODOMETRY) as wheels:
        for _ in range(COUNT):
            message = graph.odometry()
            rotation = message.pose.pose.orientation
            for axis in "xyzw":
                setattr(rotation, axis, 7.0 * getattr(rotation, axis))
            wheels.publish(message)
            status = graph.track()
    assert status.odometry_valid, "the odometry was not used"
    return "taken as the rotation that it stands for"


def transforms_of_nan(graph: LiveGraph) -> str:
    """Not-a-number and empty rotations between the camera's frames, and a frame in itself."""
    message = TFMessage()
    for parent, child, x, w in (
        (BASE_FRAME, OPTICAL_FRAME, NAN, 1.0),
        (BASE_FRAME, OPTICAL_FRAME, 0.0, 0.0),
        (BASE_FRAME, OPTICAL_FRAME, 0.0, math.inf),
        (BASE_FRAME, BASE_FRAME, 0.0, 1.0),
        ("", "", 0.0, 1.0),
    ):
        transform = TransformStamped(child_frame_id=child)
        transform.header.frame_id = parent
        transform.transform.translation.x, transform.transform.rotation.w = x, w
        message.transforms.append(transform)
    with graph.foreign(TFMessage, topics.TF_STATIC, nodes=3) as publisher:
        publisher.publish(message)
        answers = [graph.track() for _ in range(COUNT)]
        assert all(status.state == TrackingStatus.OK for status in answers), answers[-1].reason
        assert all(np.isfinite(pose).all() for pose in graph.client.poses.values())
    return "passed over"


FAULTS = (
    live(
        "live-model-bit-flip",
        "a region model with one flipped bit on the network",
        REFUSED,
        model_refused(flipped, "checksum does not match"),
        MAP_SIDE,
        quick=True,
    ),
    live(
        "live-model-truncated",
        "a region model whose data ends in the middle, with the right checksum",
        REFUSED,
        model_refused(truncated, "announces"),
        MAP_SIDE,
    ),
    live(
        "live-model-version",
        "a region model of a version that does not exist yet",
        REFUSED,
        model_refused(of_another_version, "meslam-region/9", "same MeSLAM"),
        MAP_SIDE,
    ),
    live(
        "live-model-too-large",
        "a region model of 65 MiB",
        REFUSED,
        model_refused(too_large, "68157440 bytes", received_kb=LARGE_KB),
        MAP_SIDE,
    ),
    live(
        "live-model-bomb",
        "a region model of 32 kB that decompresses to 1 GiB",
        "refused before memory is taken, counted; the map stays as it is",
        model_refused(bomb, "1073741824 bytes of content"),
        MAP_SIDE,
    ),
    live(
        "live-model-wrong-place",
        "a region model that says it lies at another place than it does inside",
        REFUSED,
        model_refused(at_another_place, "holds (0, 0, 0)"),
        MAP_SIDE,
    ),
    live(
        "live-model-no-box",
        "a region model at not-a-number with a size of -1 m",
        REFUSED,
        model_refused(without_a_box, "boxes inside and outside differ"),
        MAP_SIDE,
    ),
    live(
        "live-model-duplicates",
        "every region's model again and again, from a second publisher",
        "nothing changes",
        known_again,
        MAP_SIDE,
    ),
    live(
        "live-odometry-nan",
        "odometry whose position is not-a-number",
        WITHOUT,
        wrong_odometry(pose_of_nan, "are no pose"),
        TRACKING,
    ),
    live(
        "live-odometry-covariance-nan",
        "odometry whose covariance is not-a-number",
        "not trusted; the image is tracked without",
        wrong_odometry(covariance_of_nan),
        TRACKING,
    ),
    live(
        "live-odometry-no-rotation",
        "odometry whose quaternion has a length of 1e-200",
        WITHOUT,
        wrong_odometry(no_rotation, "are no pose"),
        TRACKING,
    ),
    live(
        "live-odometry-far-away",
        "odometry that is 1e300 m away",
        WITHOUT,
        wrong_odometry(out_of_this_world, "are no pose"),
        TRACKING,
    ),
    live(
        "live-odometry-scaled-quaternion",
        "odometry whose quaternions are seven times too long",
        "taken as the rotation that they stand for",
        scaled_quaternions,
        TRACKING,
    ),
    live(
        "live-tf-nan",
        "/tf_static with not-a-number, empty rotations and a frame that is its own parent",
        "passed over; the camera's place on the base stays as it is",
        transforms_of_nan,
    ),
)
