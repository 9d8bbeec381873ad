"""The benchmark of the nodes in real time: what is read from a run."""

from __future__ import annotations

from dataclasses import replace

import node_latency
import numpy as np
from data import ros_domain

from meslam_ros.client import MeslamClient
from meslam_ros.conversions import NANOSECONDS, to_stamp

ros_domain.enter()

RUN = node_latency.LiveResult(
    frames=100,
    poses=100,
    not_ok=0,
    dropped="none",
    latencies_ms=[50.0] * 90 + [150.0] * 10,
    ate_m=0.018,
    played_s=6.6,
    loads={"tracking_node": node_latency.Load(cpu_s=3.3, peak_mb=500.0)},
)


def test_frames_without_a_pose_are_late_for_ever():
    assert RUN.percentile(50) == 50.0
    assert RUN.percentile(95) == 150.0
    missing = replace(RUN, poses=90, latencies_ms=[50.0] * 90)
    assert missing.share == 0.9
    assert missing.percentile(50) == 50.0
    assert missing.percentile(95) == np.inf


def test_every_target_counts():
    assert node_latency.met([RUN], offline_m=0.0178)
    for worse in (
        replace(RUN, poses=97, latencies_ms=[50.0] * 97),
        replace(RUN, latencies_ms=[101.0] * 100),
        replace(RUN, latencies_ms=[50.0] * 90 + [201.0] * 10),
        replace(RUN, ate_m=0.024),
    ):
        assert not node_latency.met([RUN, worse], offline_m=0.0178)


def test_a_latency_runs_from_publication_to_arrival():
    with MeslamClient("stopwatch_test") as client:
        watch = node_latency.Stopwatch(client)
        info = client.node.create_publisher(
            node_latency.CameraInfo, node_latency.topics.COLOR_INFO, node_latency.STREAM
        )
        pose = client.node.create_publisher(
            node_latency.PoseStamped, node_latency.topics.POSE, node_latency.STREAM
        )
        publishers = (info, pose)
        assert client.spin_until(lambda: all(p.get_subscription_count() for p in publishers), 20.0)
        for seconds in (1, 2):
            message = node_latency.CameraInfo()
            message.header.stamp = to_stamp(seconds * NANOSECONDS)
            info.publish(message)
        client.spin_until(lambda: False, 0.3)
        answer = node_latency.PoseStamped()
        answer.header.stamp = to_stamp(1 * NANOSECONDS)
        pose.publish(answer)
        assert client.spin_until(lambda: bool(watch.arrived) and len(watch.published) == 2, 20.0)
    (latency_ms,) = watch.latencies_ms()
    assert latency_ms > 250.0
