"""`bag_player_node`: plays a recording of any format as if the camera were there."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.errors import RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings import open_recording
from meslam_interfaces.msg import TrackingStatus
from meslam_ros import topics
from meslam_ros.conversions import (
    NANOSECONDS,
    camera_to_info,
    color_message,
    depth_message,
    stamp_ns,
    to_stamp,
)
from meslam_ros.frame_reader import FrameReader
from meslam_ros.image_source import ImageSource, StoppedError
from meslam_ros.managed_node import USAGE_ERROR, run
from meslam_ros.node_settings import PlayerSettings
from meslam_ros.parameters import declare_settings
from meslam_ros.playback_pace import Pace, Progress
from meslam_ros.qos import STREAM
from meslam_ros.transforms import StaticBroadcaster

POLL_S = 0.02
# Subscribers come one after another; when none has come for so long, all are there.
SETTLING_S = 0.5
# What got lost can be sent again as long as the writer keeps it; acknowledgements come after
# three seconds at worst.
IMAGE_DEPTH = 60
LATE_S = 0.5
CLOCK_PERIOD_S = 0.025
PROGRESS_S = 5.0
FIRST_REPORT_S = 1.0


class BagPlayerNode(ImageSource):
    """Publishes colour, depth, camera_info, /clock and the camera's static transform."""

    def __init__(self, **options: Any) -> None:
        super().__init__("bag_player_node", **options)
        self._settings = declare_settings(self, PlayerSettings)

    def configure(self) -> None:
        self.exit_code = USAGE_ERROR
        if not self._settings.recording:
            raise RecordingError("which recording? give -p recording:=PATH after --ros-args")
        settings = self._settings
        self._recording = open_recording(Path(settings.recording))
        self._reader = FrameReader(self._recording, settings.start, settings.step, settings.frames)
        self.exit_code = 0
        self.open_publishers(IMAGE_DEPTH)
        self._clock_publisher = self.create_publisher(Clock, topics.CLOCK, STREAM)
        self._static = (
            StaticBroadcaster(self, T_BODY_OPTICAL, settings.base_frame, settings.optical_frame)
            if settings.base_frame
            else None
        )
        self._answers = threading.Condition()
        self._answered: set[int] = set()
        self._status = self.create_subscription(
            TrackingStatus, topics.STATUS, self._take_status, STREAM
        )
        self._running = threading.Event()
        self._running.set()
        self._pause = self.create_service(SetBool, topics.PLAYER_PAUSE, self._on_pause)

    def activate(self) -> None:
        self.begin()

    def deactivate(self) -> None:
        self.end()

    def cleanup(self) -> None:
        self._recording.close()
        self.destroy_service(self._pause)
        self.destroy_subscription(self._status)
        if self._static is not None:
            self._static.close()
        self.destroy_publisher(self._clock_publisher)
        self.close_publishers()

    def send_images(self) -> None:
        """Play the recording, once or again and again (`ImageSource`)."""
        self._wait_for_subscribers()
        self._play()

    def _wait_for_subscribers(self) -> None:
        """Wait until all images have their subscribers and no more are coming."""
        awaited = self.image_publishers[:3]
        started = changed = time.monotonic()
        report_s = FIRST_REPORT_S
        seen: list[int] = []
        while wanted := self._settings.subscribers:
            counted = [publisher.get_subscription_count() for publisher in awaited]
            now = time.monotonic()
            if counted != seen:
                seen, changed = counted, now
            if min(counted) >= wanted and now - changed >= SETTLING_S:
                return
            have = ", ".join(f"{p.topic_name} {n}" for p, n in zip(awaited, counted, strict=True))
            timeout_s = self._settings.wait_timeout_s
            if now - started > timeout_s:
                raise RecordingError(
                    f"after {timeout_s:.0f} s not all have {wanted} subscribers: {have}; are the "
                    "nodes running, with the same ROS_DOMAIN_ID? (subscribers:=0 does not wait)"
                )
            if min(counted) < wanted and now - started > report_s:
                report_s *= 2.0
                self.get_logger().info(
                    f"waiting up to {timeout_s:.0f} s for {wanted} subscribers each: {have}"
                )
            self.wait(POLL_S)

    def _play(self) -> None:
        while True:
            started = time.monotonic()
            count = self._play_once()
            self._wait_for_acknowledgement()
            elapsed_s = time.monotonic() - started
            self.get_logger().info(
                f"played {count} image pairs in {elapsed_s:.1f} s, "
                f"{count / max(elapsed_s, 1e-3):.1f} a second"
            )
            if not self._settings.loop:
                return

    def _play_once(self) -> int:
        """Play the recording to its end; returns the number of image pairs."""
        self._answered.clear()
        self._clock_ns = self._unacknowledged = 0
        under_way: list[int] = []
        pace = Pace()
        progress = Progress(len(self._reader), self._reader.duration_s, PROGRESS_S)
        count, late = 0, False
        for frame in self._reader.frames(self.wait):
            pace.paused(self._wait_while_paused())
            rate = self._settings.rate
            due_s = pace.next(frame.stamp_ns, time.monotonic(), rate)
            if rate > 0:
                late = self._wait_until(due_s, frame.stamp_ns, rate, late)
            else:
                self._wait_for_answers(under_way, self._settings.window - 1)
                under_way.append(frame.stamp_ns)
            self._wait_for_subscribers_to_follow()
            self._publish(frame)
            count += 1
            if (report := progress.report(frame.stamp_ns, time.monotonic())) is not None:
                self.get_logger().info(report)
        self._wait_for_answers(under_way, 0)
        return count

    def _wait_while_paused(self) -> float:
        """How long that took [s]."""
        started = time.monotonic()
        while not self._running.is_set():
            self.wait(POLL_S)
        return time.monotonic() - started

    def _publish(self, frame: RgbdFrame) -> None:
        stamp, name = to_stamp(frame.stamp_ns), self._settings.optical_frame
        self._tick(frame.stamp_ns)
        self._unacknowledged += 1
        info = camera_to_info(frame.camera, stamp, name)
        self.publish_pair(
            info,
            color_message(frame.color, stamp, name),
            depth_message(frame.depth_m, self._settings.depth_encoding, stamp, name),
        )

    def _tick(self, now_ns: int) -> None:
        """Tell the time, which never goes back within a recording."""
        if self._settings.clock and now_ns > self._clock_ns:
            self._clock_ns = now_ns
            self._clock_publisher.publish(Clock(clock=to_stamp(now_ns)))

    def _wait_until(self, due_s: float, stamp_ns: int, rate: float, late: bool) -> bool:
        """Wait for a frame's time; tells once when playback cannot keep its rate."""
        behind_s = time.monotonic() - due_s
        if behind_s > LATE_S and not late:
            self.get_logger().warn(
                "the recording cannot be read at this rate; it plays slower, nothing is dropped"
            )
            return True
        while (left_s := due_s - time.monotonic()) > 0:
            if self._clock_ns:
                self._tick(stamp_ns - round(left_s * rate * NANOSECONDS))
            self.wait(min(left_s, CLOCK_PERIOD_S))
        return late

    def _wait_for_subscribers_to_follow(self) -> None:
        """Hold playback while somebody has not taken what can only just be sent again."""
        pictures = self.image_publishers[:2]
        if all(publisher.wait_for_all_acked(Duration()) for publisher in pictures):
            self._unacknowledged = 0
        elif self._unacknowledged >= IMAGE_DEPTH - 1:
            self.get_logger().warn("a subscriber does not take the images; waiting for it")
            self._wait_for_acknowledgement()
            self._unacknowledged = 0

    def _wait_for_answers(self, under_way: list[int], allowed: int) -> None:
        """Wait until at most so many image pairs have no answer yet."""
        deadline = time.monotonic() + self._settings.wait_timeout_s
        with self._answers:
            while True:
                under_way[:] = [stamp for stamp in under_way if stamp not in self._answered]
                if len(under_way) <= allowed:
                    return
                if self._stopping.is_set():
                    raise StoppedError
                if time.monotonic() > deadline:
                    raise RecordingError(
                        f"no {topics.STATUS} came for the image at "
                        f"{under_way[0] / NANOSECONDS:.3f} s within "
                        f"{self._settings.wait_timeout_s:.0f} s; is the tracking node running? "
                        "(rate:=1.0 plays without answers)"
                    )
                self._answers.wait(POLL_S)

    def _take_status(self, message: TrackingStatus) -> None:
        with self._answers:
            self._answered.add(stamp_ns(message.header.stamp))
            self._answers.notify()

    def _wait_for_acknowledgement(self) -> None:
        """Wait until all subscribers have taken all images; tells who has not."""
        deadline = time.monotonic() + self._settings.wait_timeout_s
        for publisher in self.image_publishers:
            while not publisher.wait_for_all_acked(Duration(seconds=POLL_S)):
                self.wait(0.0)
                if time.monotonic() > deadline:
                    self.get_logger().warn(
                        f"{publisher.topic_name}: a subscriber has not taken all images; it has "
                        "lost some, or is about to"
                    )
                    break

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._running.clear()
        else:
            self._running.set()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response


def main() -> None:
    """Entry point."""
    sys.exit(run(BagPlayerNode))


if __name__ == "__main__":
    main()
