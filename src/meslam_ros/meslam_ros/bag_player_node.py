"""`bag_player_node`: plays a recording of any format as if the camera were there."""

from __future__ import annotations

import queue
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool

from meslam_core.errors import MeslamError, RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings import open_recording
from meslam_core.slam import T_BODY_OPTICAL
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
from meslam_ros.managed_node import USAGE_ERROR, ManagedNode, run
from meslam_ros.node_settings import PlayerSettings
from meslam_ros.parameters import declare_settings
from meslam_ros.qos import STREAM, images
from meslam_ros.transforms import StaticBroadcaster

PREFETCHED_FRAMES = 4
POLL_S = 0.02
# Subscribers come one after another; when none has come for so long, all are there.
SETTLING_S = 0.5
# What got lost can be sent again as long as the writer keeps it; acknowledgements come after
# three seconds at worst.
IMAGE_DEPTH = 60
LATE_S = 0.5


class PlaybackStoppedError(Exception):
    """The node is being stopped."""


class BagPlayerNode(ManagedNode):
    """Publishes colour, depth, camera_info, /clock and the camera's static transform."""

    def __init__(self, **options: Any) -> None:
        super().__init__("bag_player_node", **options)
        self._settings = declare_settings(self, PlayerSettings)

    def configure(self) -> None:
        self.exit_code = USAGE_ERROR
        if not self._settings.recording:
            raise RecordingError("which recording? give -p recording:=PATH after --ros-args")
        self._recording = open_recording(Path(self._settings.recording))
        if len(self._recording) == 0:
            raise RecordingError(f"{self._settings.recording} holds no image pair")
        self.exit_code = 0
        profile = images(ReliabilityPolicy.RELIABLE, IMAGE_DEPTH)
        self._color = self.create_publisher(Image, topics.COLOR, profile)
        self._depth = self.create_publisher(Image, topics.DEPTH, profile)
        self._color_info = self.create_publisher(CameraInfo, topics.COLOR_INFO, profile)
        self._depth_info = self.create_publisher(CameraInfo, topics.DEPTH_INFO, profile)
        self._clock_publisher = self.create_publisher(Clock, topics.CLOCK, STREAM)
        self._publishers_of_images = (self._color, self._depth, self._color_info, self._depth_info)
        if self._settings.base_frame:
            T_base_optical = T_BODY_OPTICAL
            self._static = StaticBroadcaster(
                self, T_base_optical, self._settings.base_frame, self._settings.optical_frame
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
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def deactivate(self) -> None:
        self._stopping.set()
        self._thread.join()

    def cleanup(self) -> None:
        self._recording.close()
        self.destroy_service(self._pause)
        self.destroy_subscription(self._status)
        for publisher in (*self._publishers_of_images, self._clock_publisher):
            self.destroy_publisher(publisher)

    def _run(self) -> None:
        try:
            self._wait_for_subscribers()
            self._play()
        except PlaybackStoppedError:
            return
        except MeslamError as error:
            self.exit_code = USAGE_ERROR
            self.get_logger().error(str(error))
        except Exception:
            self.exit_code = 1
            self.get_logger().fatal(traceback.format_exc())
        self.stop()

    def _wait_for_subscribers(self) -> None:
        """Wait until both images have their subscribers and no more are coming."""
        wanted = self._settings.subscribers
        started = changed = time.monotonic()
        seen: tuple[int, ...] = ()
        announced = False
        while wanted:
            counted = (
                self._color.get_subscription_count(),
                self._depth.get_subscription_count(),
                self._color_info.get_subscription_count(),
            )
            now = time.monotonic()
            if counted != seen:
                seen, changed = counted, now
            if min(counted) >= wanted and now - changed >= SETTLING_S:
                return
            if not announced and now - started > 1.0:
                announced = True
                self.get_logger().info(
                    f"waiting for {wanted} subscribers of {self._color.topic_name} and "
                    f"{self._depth.topic_name}"
                )
            if now - started > self._settings.wait_timeout_s:
                raise RecordingError(
                    f"after {self._settings.wait_timeout_s:.0f} s {self._color.topic_name}, "
                    f"{self._depth.topic_name} and {self._color_info.topic_name} have "
                    f"{counted} subscribers, expected {wanted} each; are the nodes running, with "
                    "the same ROS_DOMAIN_ID?"
                )
            self._wait(POLL_S)

    def _play(self) -> None:
        settings = self._settings
        while True:
            started = time.monotonic()
            count = self._play_once()
            self._wait_for_acknowledgement()
            elapsed_s = time.monotonic() - started
            self.get_logger().info(
                f"played {count} image pairs in {elapsed_s:.1f} s, "
                f"{count / max(elapsed_s, 1e-3):.1f} a second"
            )
            if not settings.loop:
                return

    def _play_once(self) -> int:
        """Play the recording to its end; returns the number of image pairs."""
        self._answered.clear()
        under_way: list[int] = []
        first_ns, first_s, count = 0, 0.0, 0
        late = False
        for frame in self._frames():
            while not self._running.is_set():
                paused_s = time.monotonic()
                self._wait(POLL_S)
                first_s += time.monotonic() - paused_s
            if self._settings.rate > 0:
                if count == 0:
                    first_ns, first_s = frame.stamp_ns, time.monotonic()
                due_s = (frame.stamp_ns - first_ns) / NANOSECONDS / self._settings.rate + first_s
                late = self._wait_until(due_s, late)
            else:
                self._wait_for_answers(under_way, self._settings.window - 1)
                under_way.append(frame.stamp_ns)
            self._publish(frame)
            count += 1
        self._wait_for_answers(under_way, 0)
        if count == 0:
            raise RecordingError(
                f"{self._settings.recording} has no image pair after start = "
                f"{self._settings.start} s"
            )
        return count

    def _frames(self) -> Iterator[RgbdFrame]:
        """Frames from the starting time on, decoded ahead by another thread."""
        frames: queue.Queue[RgbdFrame | Exception | None] = queue.Queue(PREFETCHED_FRAMES)
        thread = threading.Thread(target=self._decode, args=(frames,), daemon=True)
        thread.start()
        while True:
            self._wait(0.0)
            try:
                frame = frames.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if isinstance(frame, Exception):
                raise frame
            if frame is None:
                return
            yield frame

    def _decode(self, frames: queue.Queue[RgbdFrame | Exception | None]) -> None:
        def put(entry: RgbdFrame | Exception | None) -> None:
            while not self._stopping.is_set():
                with suppress(queue.Full):
                    frames.put(entry, timeout=POLL_S)
                    return

        try:
            limit = self._settings.frames or None
            for frame in islice(self._selected(), limit):
                put(frame)
                if self._stopping.is_set():
                    return
            put(None)
        except Exception as error:
            put(error)

    def _selected(self) -> Iterator[RgbdFrame]:
        first_ns: int | None = None
        for frame in self._recording.frames(step=self._settings.step):
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            if frame.stamp_ns - first_ns >= self._settings.start * NANOSECONDS:
                yield frame

    def _publish(self, frame: RgbdFrame) -> None:
        stamp, name = to_stamp(frame.stamp_ns), self._settings.optical_frame
        if self._settings.clock:
            self._clock_publisher.publish(Clock(clock=stamp))
        info = camera_to_info(frame.camera, stamp, name)
        self._color_info.publish(info)
        self._depth_info.publish(info)
        self._color.publish(color_message(frame.color, stamp, name))
        self._depth.publish(
            depth_message(frame.depth_m, self._settings.depth_encoding, stamp, name)
        )

    def _wait_until(self, due_s: float, late: bool) -> bool:
        """Wait for a frame's time; tells once when playback cannot keep its rate."""
        behind_s = time.monotonic() - due_s
        if behind_s > LATE_S and not late:
            self.get_logger().warn(
                "the recording cannot be read at this rate; it plays slower, nothing is dropped"
            )
            return True
        while (left_s := due_s - time.monotonic()) > 0:
            self._wait(left_s)
        return late

    def _wait_for_answers(self, under_way: list[int], allowed: int) -> None:
        """Wait until at most so many image pairs have no answer yet."""
        deadline = time.monotonic() + self._settings.wait_timeout_s
        with self._answers:
            while True:
                under_way[:] = [stamp for stamp in under_way if stamp not in self._answered]
                if len(under_way) <= allowed:
                    return
                if self._stopping.is_set():
                    raise PlaybackStoppedError
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
        for publisher in self._publishers_of_images:
            timeout = Duration(seconds=self._settings.wait_timeout_s)
            if not publisher.wait_for_all_acked(timeout):
                self.get_logger().warn(f"{publisher.topic_name}: not all images were acknowledged")

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._running.clear()
        else:
            self._running.set()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _wait(self, seconds: float) -> None:
        if self._stopping.wait(seconds):
            raise PlaybackStoppedError


def main() -> None:
    """Entry point."""
    sys.exit(run(BagPlayerNode))


if __name__ == "__main__":
    main()
