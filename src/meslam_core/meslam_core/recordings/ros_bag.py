"""ROS bags: rosbag2 folders, single .mcap and .db3 files, ROS 1 .bag files."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core import se3
from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import RgbdFrame, depth_to_metres
from meslam_core.recordings.calibration_watch import CalibrationWatch
from meslam_core.recordings.images import color_from_message, depth_from_message
from meslam_core.recordings.lens import Lens
from meslam_core.recordings.messages import MessageSource
from meslam_core.recordings.pairing import ordered_pairs
from meslam_core.recordings.topics import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    ChosenTopics,
    ImageTopic,
    RecordingTopics,
    choose_topics,
)
from meslam_core.recordings.transforms import depth_to_color

MAX_LATENESS = 30
"""Frames that come later than this many others are skipped: sorting them in needs memory."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Index:
    """Where the images of every pair are: their numbers in the order of recording."""

    stamps_ns: NDArray[np.int64]
    color: NDArray[np.int64]
    depth: NDArray[np.int64]
    color_times_ns: NDArray[np.int64]
    depth_times_ns: NDArray[np.int64]
    damage: RecordingError | None


@dataclass(frozen=True)
class _Registration:
    """The depth camera, and T_color_depth (4, 4) [m] from it to the colour camera."""

    camera: PinholeCamera
    lens: Lens
    T_color_depth: se3.Pose

    def apply(
        self, depth_m: NDArray[np.float32], color_camera: PinholeCamera
    ) -> NDArray[np.float32]:
        undistorted = self.lens.undistort_depth(depth_m)
        return register_depth_to_color(undistorted, self.camera, color_camera, self.T_color_depth)


class RosBagRecording:
    """Colour and depth images of a ROS bag, paired by stamp, depth registered to colour.

    The images are read in one pass a call of `frames`; opening reads the headers of all images
    once. Where a bag is damaged, the frames before the damage are yielded, then an error is raised.
    """

    def __init__(
        self,
        path: Path,
        source: MessageSource,
        camera: PinholeCamera | None = None,
        topics: RecordingTopics | None = None,
    ) -> None:
        """Choose topics and read the calibration.

        Args:
            path: of the bag.
            source: its messages; closed by `close`.
            camera: intrinsics that replace the colour camera info's.
            topics: names that replace the detected ones.

        Raises:
            RecordingError: when topics, calibration or transforms are missing.
        """
        self.name = path.name
        self.path = path
        self.format = source.format
        self._source = source
        chosen = choose_topics(
            self.name, self._image_topics(), source.types, topics or RecordingTopics()
        )
        self.topics = {role: topic for role, topic in vars(chosen).items() if topic is not None}
        self._color_topic, self._depth_topic = chosen.color, chosen.depth
        self._camera_given = camera is not None
        infos = {chosen.depth_info, None if self._camera_given else chosen.color_info}
        self._calibration_watch = CalibrationWatch(self.name, source, infos - {None})
        if camera is not None:
            self._camera, self._lens = camera, Lens(camera)
        else:
            self._camera, self._lens = self._calibration(chosen.color_info)
        self._registration = self._depth_registration(chosen)

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the colour camera."""
        return self._camera

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the colour images [ns], increasing."""
        return self._index.stamps_ns

    def __len__(self) -> int:
        return len(self._index.stamps_ns)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """Decode the pairs `start:stop:step`; see `Recording.frames`."""
        numbers = range(len(self))[start:stop:step]
        for number, color, depth in self._raw_pairs(numbers):
            yield self._decode(number, color, depth)
        damage = self._index.damage
        if damage is not None and (stop is None or stop > len(self)):
            raise RecordingError(f"{damage}; {len(self)} frames could be read") from damage

    def close(self) -> None:
        """Release the bag; idempotent."""
        self._source.close()

    def _raw_pairs(self, numbers: range) -> Iterator[tuple[int, bytes, bytes]]:
        """(number, colour, depth) serialised, in order; keeps only what waits for its turn."""
        index = self._index
        if not len(numbers):
            return
        wanted: dict[str, dict[int, int]] = {self._color_topic: {}, self._depth_topic: {}}
        for number in numbers:
            wanted[self._color_topic][int(index.color[number])] = number
            wanted[self._depth_topic][int(index.depth[number])] = number
        start_ns, ordinals = self._first_needed(numbers)
        waiting: dict[int, dict[str, bytes]] = {}
        remaining = iter(numbers)
        following = next(remaining)
        for topic, _, raw in self._source.messages(list(wanted), start_ns):
            found = wanted[topic].get(ordinals[topic])
            ordinals[topic] += 1
            if found is not None:
                waiting.setdefault(found, {})[topic] = raw
            while len(waiting.get(following, ())) == 2:
                pair = waiting.pop(following)
                yield following, pair[self._color_topic], pair[self._depth_topic]
                if following == numbers[-1]:
                    return
                following = next(remaining)

    def _first_needed(self, numbers: range) -> tuple[int | None, dict[str, int]]:
        """Time to read from, and the numbers of the first images at or after it."""
        index = self._index
        color_times, depth_times = index.color_times_ns, index.depth_times_ns
        ordered = np.all(np.diff(color_times) >= 0) and np.all(np.diff(depth_times) >= 0)
        if not ordered:
            return None, {self._color_topic: 0, self._depth_topic: 0}
        chosen = np.asarray(numbers)
        start_ns = int(
            min(color_times[index.color[chosen]].min(), depth_times[index.depth[chosen]].min())
        )
        return start_ns, {
            self._color_topic: int(np.searchsorted(color_times, start_ns)),
            self._depth_topic: int(np.searchsorted(depth_times, start_ns)),
        }

    def _decode(self, number: int, color_raw: bytes, depth_raw: bytes) -> RgbdFrame:
        try:
            color = color_from_message(self._source.deserialize(color_raw, self._color_topic))
            depth = depth_from_message(self._source.deserialize(depth_raw, self._depth_topic))
            depth_m = depth_to_metres(depth)
            if self._registration is None:
                depth_m = self._lens.undistort_depth(depth_m)
            else:
                depth_m = self._registration.apply(depth_m, self._camera)
            return RgbdFrame(
                int(self._index.stamps_ns[number]),
                self._lens.undistort_color(color),
                depth_m,
                self._camera,
            )
        except (FrameError, RecordingError) as error:
            raise RecordingError(
                f"{self.name}, frame {number} ({self._color_topic}, {self._depth_topic}): {error}"
            ) from error

    @cached_property
    def _index(self) -> _Index:
        stamps: dict[str, list[int]] = {self._color_topic: [], self._depth_topic: []}
        times: dict[str, list[int]] = {self._color_topic: [], self._depth_topic: []}
        arrivals: dict[str, list[int]] = {self._color_topic: [], self._depth_topic: []}
        damage = None
        try:
            topics = {*stamps, *self._calibration_watch.topics}
            for arrival, (topic, time_ns, raw) in enumerate(self._source.messages(topics)):
                if topic not in stamps:
                    self._calibration_watch.see(topic, time_ns, raw)
                    continue
                stamps[topic].append(self._source.stamp_ns(raw))
                times[topic].append(time_ns)
                arrivals[topic].append(arrival)
        except RecordingError as error:
            damage = error
            logger.warning("%s; reading what comes before", error)
        # Drivers without a clock leave all stamps at zero.
        if not any(map(any, stamps.values())):
            stamps = times
        color_ns = np.array(stamps[self._color_topic], np.int64)
        depth_ns = np.array(stamps[self._depth_topic], np.int64)
        try:
            pairs = np.array(ordered_pairs(self.name, color_ns, depth_ns), np.int64)
        except RecordingError as error:
            raise damage or error from error
        complete = np.maximum(
            np.array(arrivals[self._color_topic])[pairs[:, 0]],
            np.array(arrivals[self._depth_topic])[pairs[:, 1]],
        )
        pairs = pairs[self._in_time(complete)]
        return _Index(
            stamps_ns=color_ns[pairs[:, 0]],
            color=pairs[:, 0],
            depth=pairs[:, 1],
            color_times_ns=np.array(times[self._color_topic], np.int64),
            depth_times_ns=np.array(times[self._depth_topic], np.int64),
            damage=damage,
        )

    def _in_time(self, complete: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which pairs do not keep more than `MAX_LATENESS` later ones waiting for them."""
        rank = np.empty(len(complete), np.int64)
        rank[np.argsort(complete, kind="stable")] = np.arange(len(complete))
        in_time: NDArray[np.bool_] = rank - np.arange(len(complete)) <= MAX_LATENESS
        if not in_time.all():
            logger.warning(
                "%s: skipped %d frames that come more than %d frames late",
                self.name,
                np.count_nonzero(~in_time),
                MAX_LATENESS,
            )
        return in_time

    def _image_topics(self) -> list[ImageTopic]:
        images = []
        for topic, message_type in sorted(self._source.types.items()):
            if message_type == IMAGE_TYPE:
                encoding = self._first(topic).encoding
            elif message_type == COMPRESSED_IMAGE_TYPE:
                encoding = self._first(topic).format.partition(";")[0].strip()
            else:
                continue
            compressed = message_type == COMPRESSED_IMAGE_TYPE
            images.append(ImageTopic(topic, encoding, compressed))
        return images

    def _first(self, topic: str) -> Any:
        for _, _, raw in self._source.messages([topic]):
            return self._source.deserialize(raw, topic)
        raise RecordingError(f"{self.name} has no messages on {topic}; record that topic too")

    def _calibration(self, info_topic: str | None) -> tuple[PinholeCamera, Lens]:
        if info_topic is None:
            raise RecordingError(
                f"{self.name} has no camera info for its images; "
                "record it, or give the intrinsics with --camera camera.json"
            )
        # ROS 1 has capitals where ROS 2 has small letters.
        fields = {key.lower(): value for key, value in vars(self._first(info_topic)).items()}
        k = fields["k"]
        try:
            camera = PinholeCamera(
                int(fields["width"]), int(fields["height"]), *map(float, (k[0], k[4], k[2], k[5]))
            )
            return camera, Lens(camera, fields["distortion_model"], fields["d"])
        except FrameError as error:
            raise RecordingError(
                f"{self.name}: the camera info on {info_topic} has no intrinsics ({error}); "
                "give them with --camera camera.json"
            ) from error

    def _depth_registration(self, chosen: ChosenTopics) -> _Registration | None:
        """How depth gets into the colour camera, or None where it is there already."""
        depth_message = self._first(self._depth_topic)
        depth_frame = depth_message.header.frame_id
        color_frame = self._first(self._color_topic).header.frame_id
        if chosen.depth_info is None or (self._camera_given and depth_frame == color_frame):
            self._check_registered(depth_message)
            return None
        depth_camera, depth_lens = self._calibration(chosen.depth_info)
        T_color_depth = depth_to_color(self._source, depth_frame, color_frame)
        if _same(depth_camera, self._camera) and np.allclose(T_color_depth, np.eye(4), atol=1e-5):
            return None
        return _Registration(depth_camera, depth_lens, T_color_depth)

    def _check_registered(self, depth_message: Any) -> None:
        height, width = depth_from_message(depth_message).shape
        if (width, height) != (self._camera.width, self._camera.height):
            raise RecordingError(
                f"{self.name}: depth images on {self._depth_topic} are {width}x{height}, colour is "
                f"{self._camera.width}x{self._camera.height}, and nothing tells how to register "
                "them; record the depth camera_info, or depth that is aligned to colour"
            )


def _same(first: PinholeCamera, second: PinholeCamera) -> bool:
    return (first.width, first.height) == (second.width, second.height) and np.allclose(
        (first.fx, first.fy, first.cx, first.cy),
        (second.fx, second.fy, second.cx, second.cy),
        atol=0.05,
    )
