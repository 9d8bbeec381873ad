"""Cameras and recordings whose time is wrong, in running nodes."""

from __future__ import annotations

import numpy as np
from faults.live_graph import Change, LiveGraph
from faults.live_trial import CAMERA_SIDE, live, refused
from rosgraph_msgs.msg import Clock

from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import NANOSECONDS, to_stamp
from meslam_ros.qos import STREAM

FAR_AHEAD_NS = 2_000_000_000 * NANOSECONDS
ONE_WRONG = "the pair is refused with the reason and counted; the map goes on"


def stamped(stamp_ns: int) -> Change:
    """All messages with this stamp [ns]."""

    def apply(messages) -> None:
        for message in messages:
            message.header.stamp = to_stamp(stamp_ns)

    return apply


def one_stamp(stamp_ns: int):
    """One pair with a wrong stamp [ns]."""

    def disturb(graph: LiveGraph) -> str:
        graph.stamp_ns += 100 * NANOSECONDS
        graph.track_well()
        seen = refused([graph.track(stamped(stamp_ns))], "stamp jumps", "the next pairs")
        graph.reported("tracking_node", "stamps that jump: ")
        return seen

    return disturb


def all_stamps_zero(graph: LiveGraph) -> str:
    """A driver that never fills the stamps."""
    before = len(graph.client.statuses)
    for _ in range(30):
        graph.send(stamped(0))
        graph.wait(0.1)
    told = graph.client.statuses[before:]
    assert all(status.state != TrackingStatus.OK for status in told), "frames of no time are OK"
    graph.logged("tracking_node", "stamps do not grow")
    return "the log says that stamps do not grow"


def equal_stamps(graph: LiveGraph) -> str:
    """A driver that is stuck at one stamp."""
    stamp_ns = graph.stamp_ns
    before = len(graph.client.statuses)
    for _ in range(10):
        graph.send(stamped(stamp_ns))
        graph.wait(0.05)
    after = graph.track_well(1)
    assert len(graph.client.statuses) == before + 1, "images of the same instant were tracked"
    assert "came too late: 10" in after.drop_reasons, after.drop_reasons
    return after.drop_reasons


def random_order(graph: LiveGraph) -> str:
    """Four seconds of images, shuffled."""
    first_ns = graph.stamp_ns
    views = [graph.view() for _ in range(60)]
    before = graph.client.statuses[-1]
    for place in np.random.default_rng(4).permutation(len(views)):
        graph.camera.send(views[place])
        graph.wait(0.02)
    stamps = [s for s in graph.client.poses if s > first_ns]
    assert stamps == sorted(stamps), "poses are not in the order of their stamps"
    after = graph.track_well()
    assert after.map_id == before.map_id, "a new map was begun"
    return f"{len(stamps)} of 60 tracked, the rest counted: {after.drop_reasons}"


def burst_and_gap(graph: LiveGraph) -> str:
    """Sixty pairs at once, then nothing for two seconds."""
    before = graph.client.statuses[-1]
    longest = 0
    for _ in range(60):
        graph.send()
    last_ns = graph.stamp_ns
    graph.until(lambda: graph.client.last_stamp_ns == last_ns, "answered the burst's last pair")
    statuses = [s for s in graph.client.statuses if s is not before]
    longest = max(status.queue_length for status in statuses)
    graph.stamp_ns += 2 * NANOSECONDS
    after = graph.track_well()
    assert longest <= 30, f"{longest} pairs waited"
    assert after.map_id == before.map_id, "a new map was begun"
    lost = after.drop_reasons or "nothing lost"
    return f"at most {longest} pairs waited; {lost}"


def stands_still(graph: LiveGraph) -> str:
    """Half a minute without images, then the camera goes on."""
    graph.wait(3.0)
    graph.stamp_ns += 30 * NANOSECONDS
    seen = refused([graph.track()], "stamp jumps by 30")
    graph.logged("tracking_node", "no image pair for")
    return seen


def recording_again(graph: LiveGraph) -> str:
    """A recording in a loop, with a clock that jumps back with it."""
    clock = graph.client.node.create_publisher(Clock, topics.CLOCK, STREAM)
    first = graph.client.statuses[-1]
    graph.stamp_ns += 100 * NANOSECONDS
    clock.publish(Clock(clock=to_stamp(graph.stamp_ns)))
    graph.track_well()
    kept = graph.settle()
    graph.stamp_ns = NANOSECONDS
    clock.publish(Clock(clock=to_stamp(graph.stamp_ns)))
    after = graph.track_well()
    assert kept == first.map_id
    assert after.map_id != first.map_id, "the map did not begin anew"
    folder = graph.folder / "maps" / "recent" / first.map_id
    graph.until(lambda: (folder / "manifest.json").exists(), "kept the first map")
    return "a new map; the one before is kept in recent/"


FAULTS = (
    live(
        "live-stamp-zero-once",
        "one image pair whose stamp is zero",
        ONE_WRONG,
        one_stamp(0),
        CAMERA_SIDE,
    ),
    live(
        "live-stamp-far-ahead-once",
        "one image pair stamped in the year 2033",
        ONE_WRONG,
        one_stamp(FAR_AHEAD_NS),
        CAMERA_SIDE,
        quick=True,
    ),
    live(
        "live-stamps-zero",
        "three seconds of images whose stamps are all zero",
        "no pose is given; the log asks for stamps; good ones are tracked in the same map",
        all_stamps_zero,
        CAMERA_SIDE,
        input_timeout_s=1.0,
    ),
    live(
        "live-stamps-equal",
        "ten images with the stamp of the one before",
        "counted as too late, never tracked twice",
        equal_stamps,
        CAMERA_SIDE,
    ),
    live(
        "live-random-order",
        "sixty image pairs in random order",
        "poses in the order of their stamps, the rest counted, the same map",
        random_order,
        CAMERA_SIDE,
    ),
    live(
        "live-burst-and-gap",
        "sixty image pairs at once, then none for two seconds",
        "the queue is bounded, what it drops is counted, the same map goes on",
        burst_and_gap,
        CAMERA_SIDE,
    ),
    live(
        "live-silence",
        "no images for three seconds, then stamps half a minute later",
        "the log explains the silence; tracking goes on in the same map",
        stands_still,
        CAMERA_SIDE,
        input_timeout_s=1.0,
    ),
    live(
        "live-recording-loops",
        "a recording that starts again, with a /clock that jumps back, under use_sim_time",
        "a new map begins, the one before is kept whole",
        recording_again,
        same_map=False,
        use_sim_time=True,
    ),
)
