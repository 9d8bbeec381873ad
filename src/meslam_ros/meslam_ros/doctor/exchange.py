"""Whether images go from one process to another, as from camera to SLAM.

`python -m meslam_ros.doctor.exchange talk TOPIC` publishes images until it is ended;
`... listen TOPIC` waits for them and prints how many of COUNT it got, as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

from meslam_core.doctor import Finding, fail, ok, warn
from meslam_ros.processes import STOPPING_S

COUNT = 30
FPS = 15.0
SIZE = (480, 640)
# To start two processes and to find each other, on a loaded computer.
LIMIT_S = 30.0
LEAST_SHARE = 0.9
NOTHING = (
    "check the findings on domain, multicast and shared memory; stop other ROS programs and try "
    "again; a firewall must let UDP ports from 7400 pass on this computer"
)
LOST = "see the findings on the image profile and on shared memory; end other programs"


def examine_exchange() -> Finding:
    """Let one process publish images and another one listen."""
    topic = f"/meslam_doctor_{os.getpid()}"
    program = [sys.executable, "-m", "meslam_ros.doctor.exchange"]
    talker = subprocess.Popen(
        [*program, "talk", topic], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        heard = subprocess.run(
            [*program, "listen", topic],
            capture_output=True,
            text=True,
            timeout=2 * LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return fail("exchange", f"the listener does not end within {2 * LIMIT_S:g} s", NOTHING)
    finally:
        _end(talker)
    if heard.returncode:
        said = heard.stderr.strip().splitlines() or ["it says nothing"]
        return fail("exchange", f"the listener fails: {said[-1]}", NOTHING)
    told = json.loads(heard.stdout.splitlines()[-1])
    return exchanged(told["got"], told["sent"], told["latency_ms"])


def _end(talker: subprocess.Popen[bytes]) -> None:
    """Let it clean up after itself: killed, it would leave shared memory behind."""
    talker.terminate()
    try:
        talker.wait(STOPPING_S)
    except subprocess.TimeoutExpired:
        talker.kill()
        talker.wait()


def exchanged(got: int, sent: int, latency_ms: float) -> Finding:
    """Judge what arrived.

    Args:
        got: images that arrived.
        sent: that could have arrived since the first one did.
        latency_ms: from sending to arrival, median.
    """
    if not got:
        told = f"no image arrives from another process within {LIMIT_S:g} s"
        return fail("exchange", told, NOTHING)
    told = f"{got} of {sent} images between two processes, {latency_ms:.0f} ms on the way"
    return ok("exchange", told) if got >= LEAST_SHARE * sent else warn("exchange", told, LOST)


def talk(topic: str) -> None:
    """Publish numbered images at a camera's rate until the process is ended."""
    import rclpy
    from rclpy.exceptions import InvalidHandle
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node("meslam_doctor_talker")
    publisher = node.create_publisher(Image, topic, qos_profile_sensor_data)
    height, width = SIZE
    image = Image(height=height, width=width, encoding="rgb8", step=3 * width)
    image.data = bytes(3 * width * height)
    number, deadline = 0, time.monotonic() + 3 * LIMIT_S
    while rclpy.ok() and time.monotonic() < deadline:
        image.header.frame_id = str(number)
        image.header.stamp = node.get_clock().now().to_msg()
        # The context may end, by a signal, after it was asked.
        with suppress(InvalidHandle, RuntimeError):
            publisher.publish(image)
        number += 1
        time.sleep(1.0 / FPS)
    node.destroy_node()
    rclpy.try_shutdown()


def listen(topic: str, limit_s: float) -> dict[str, Any]:
    """Wait for images; which arrived of COUNT since the first one did."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node("meslam_doctor_listener")
    arrived: dict[int, float] = {}

    def take(image: Image) -> None:
        age = node.get_clock().now() - Time.from_msg(image.header.stamp)
        arrived[int(image.header.frame_id)] = age.nanoseconds / 1e6

    node.create_subscription(Image, topic, take, qos_profile_sensor_data)
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
        if arrived and max(arrived) - min(arrived) >= COUNT - 1:
            break
    node.destroy_node()
    rclpy.try_shutdown()
    sent = max(arrived) - min(arrived) + 1 if arrived else 0
    latencies = sorted(arrived.values())
    middle = latencies[len(latencies) // 2] if latencies else 0.0
    return {"got": len(arrived), "sent": sent, "latency_ms": middle}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("role", choices=("talk", "listen"))
    parser.add_argument("topic")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="of listening [s]")
    told = parser.parse_args()
    if told.role == "talk":
        talk(told.topic)
    else:
        print(json.dumps(listen(told.topic, told.limit)))


if __name__ == "__main__":
    main()
