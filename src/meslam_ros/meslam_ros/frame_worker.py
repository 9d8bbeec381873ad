"""The thread that takes image pairs from the executor and computes with them."""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from meslam_core.errors import FrameError, MeslamError
from meslam_core.frame import RgbdFrame
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.frame_queue import FrameQueue
from meslam_ros.image_synchronizer import RESTART_S, ImagePair
from meslam_ros.managed_node import ManagedNode
from meslam_ros.node_settings import FrameSettings, InputSettings
from meslam_ros.rgbd_input import RgbdInput
from meslam_ros.transforms import CameraMount

POLL_S = 0.05
WARNING_PERIOD_S = 5.0
QUEUE_FULL = "queue full"


class FrameConsumer(Protocol):
    """What the worker calls, always in its own thread."""

    def restart(self, reason: str) -> None:
        """Begin anew; what comes next has no connection to what came before."""

    def process(self, frame: RgbdFrame, mount: CameraMount, pair: ImagePair) -> None:
        """Compute with the next frame."""

    def refuse(self, pair: ImagePair, reason: str) -> None:
        """Take note of a pair that cannot be used."""

    def idle(self, silence_s: float) -> None:
        """No pair has come for a while [s]; called again and again until one does."""


class FrameWorker:
    """Input, bounded queue and thread of a node that computes with frames.

    Args:
        node: whose executor listens; stopped when the consumer fails.
        settings, frames: of the input.
        queue_size: tells how many image pairs may wait.
        consumer: of the frames.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: InputSettings,
        frames: FrameSettings,
        queue_size: Callable[[], int],
        consumer: FrameConsumer,
    ) -> None:
        self._node = node
        self._consumer = consumer
        self._queue: FrameQueue[ImagePair] = FrameQueue(queue_size)
        self._last_stamp_ns: int | None = None
        self._stopping = threading.Event()
        self._warned_dropping_s = 0.0
        self.input = RgbdInput(node, settings, frames, self._take)
        self._thread = threading.Thread(target=self._run, name="frame worker", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Pairs in the queue."""
        return len(self._queue)

    @property
    def dropped(self) -> Counter[str]:
        """Pairs that were not processed, and images that found no partner, by reason."""
        losses = self.input.losses
        losses[QUEUE_FULL] += self._queue.dropped
        return +losses

    def close(self) -> None:
        """Stop listening and wait for the frame under way."""
        self._stopping.set()
        self.input.close()
        self._queue.close()
        self._thread.join()

    def _take(self, pair: ImagePair) -> None:
        if self._queue.put(pair):
            return
        now = time.monotonic()
        if now - self._warned_dropping_s > WARNING_PERIOD_S:
            self._warned_dropping_s = now
            self._node.get_logger().warn(
                f"the queue is full, {self._queue.dropped} image pairs dropped so far: this "
                "computer is slower than the camera. Lower the frame rate, mapping.iterations "
                "or the image size"
            )

    def _run(self) -> None:
        last_s = time.monotonic()
        try:
            while not self._stopping.is_set():
                pair = self._queue.get(POLL_S)
                if pair is None:
                    self._consumer.idle(time.monotonic() - last_s)
                    continue
                self._process(pair)
                last_s = time.monotonic()
        except MeslamError as error:
            self._fail(str(error))
        except Exception:
            self._fail(traceback.format_exc())

    def _fail(self, message: str) -> None:
        if not self._stopping.is_set():
            self._node.get_logger().fatal(message)
            self._node.exit_code = 1
            self._node.stop()

    def _process(self, pair: ImagePair) -> None:
        last = self._last_stamp_ns
        if last is not None and pair.stamp_ns < last - RESTART_S * NANOSECONDS:
            self._consumer.restart(
                f"stamps jumped back by {(last - pair.stamp_ns) / NANOSECONDS:.1f} s, so the "
                "recording has started again"
            )
        self._last_stamp_ns = pair.stamp_ns
        try:
            mount = self._wait_for_mount(pair)
            frame = self.input.frame(pair)
        except FrameError as error:
            self.input.dropped["unusable images"] += 1
            self._node.get_logger().error(str(error), throttle_duration_sec=WARNING_PERIOD_S)
            self._consumer.refuse(pair, str(error))
            return
        if mount is not None:
            self._consumer.process(frame, mount, pair)

    def _wait_for_mount(self, pair: ImagePair) -> CameraMount | None:
        """The camera's mount; None when the worker is stopped meanwhile."""
        while (mount := self.input.mount(pair)) is None:
            if self._stopping.wait(POLL_S):
                return None
        return mount
