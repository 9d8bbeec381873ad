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
from meslam_ros.image_synchronizer import ImagePair
from meslam_ros.managed_node import ManagedNode
from meslam_ros.node_settings import FrameSettings, InputSettings
from meslam_ros.overload import Overload
from meslam_ros.rgbd_input import RgbdInput
from meslam_ros.stamp_guard import StampGuard, Verdict
from meslam_ros.transforms import CameraMount

POLL_S = 0.05
WARNING_PERIOD_S = 5.0
QUEUE_FULL = "queue full"
WAITED_TOO_LONG = "waited too long"
UNUSABLE = "unusable images"
WRONG_STAMP = "stamps that jump"


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

    On a computer that is too slow for its camera, pairs are skipped, and so that poses are not
    late besides, those that waited for long give way to newer ones.

    Args:
        node: whose executor listens; stopped when the consumer fails.
        settings, frames: of the input.
        queue_size: tells how many image pairs may wait.
        consumer: of the frames.

    Attributes:
        overload: why this computer is too slow for its camera; empty while it is not.
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
        self._settings = settings
        self._stamps = StampGuard()
        self._overdue = 0
        self._load = Overload(lambda: settings.overload_share)
        self.overload = ""
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
        losses[WAITED_TOO_LONG] += self._overdue
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
                self.measure_load()
                if pair is None:
                    self._consumer.idle(time.monotonic() - last_s)
                elif self._is_overdue(pair):
                    self._overdue += 1
                else:
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

    def measure_load(self) -> None:
        """Renew `overload`; what got lost on its way had nobody to take it either."""
        lost = max(self.input.lost.values(), default=0)
        skipped = self._queue.dropped + self._overdue + lost
        self.overload = self._load.count(self.input.pairs + lost, skipped)

    def _is_overdue(self, pair: ImagePair) -> bool:
        """Whether a pair gives way to newer ones, so that poses are not late."""
        waited_s = time.monotonic() - pair.arrival_s
        return bool(self.overload and self.waiting) and waited_s > self._settings.max_wait_s

    def _process(self, pair: ImagePair) -> None:
        if not self._check_stamp(pair):
            return
        try:
            mount = self._wait_for_mount(pair)
            frame = self.input.frame(pair)
        except FrameError as error:
            self._refuse(pair, UNUSABLE, str(error))
            return
        if mount is not None:
            self._consumer.process(frame, mount, pair)

    def _check_stamp(self, pair: ImagePair) -> bool:
        """Whether a pair's time can be believed; tells the consumer of a new beginning."""
        last_ns = self._stamps.last_ns
        verdict = self._stamps.judge(pair.stamp_ns)
        if verdict is Verdict.GOES_ON:
            return True
        assert last_ns is not None
        jump_s = (pair.stamp_ns - last_ns) / NANOSECONDS
        if verdict is Verdict.BEGINS_ANEW:
            self._consumer.restart(
                f"stamps jumped back by {-jump_s:.1f} s, so the recording has started again"
            )
            return True
        reason = f"the stamp {verdict.value} by {jump_s:.3f} s against the image pair before"
        if verdict is Verdict.JUMPS:
            reason += "; it is believed when the next pairs go on from there"
        self._refuse(pair, WRONG_STAMP, reason)
        return False

    def _refuse(self, pair: ImagePair, kind: str, reason: str) -> None:
        self.input.dropped[kind] += 1
        self._node.get_logger().error(reason, throttle_duration_sec=WARNING_PERIOD_S)
        self._consumer.refuse(pair, reason)

    def _wait_for_mount(self, pair: ImagePair) -> CameraMount | None:
        """The camera's mount; None when the worker is stopped meanwhile."""
        while (mount := self.input.mount(pair)) is None:
            if self._stopping.wait(POLL_S):
                return None
        return mount
