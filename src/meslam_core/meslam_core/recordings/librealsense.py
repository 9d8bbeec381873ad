"""Files of librealsense's own recorder: ROS 1 `.bag` and the newer `.db3`."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import closing
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.errors import FrameError, RecordingError
from meslam_core.frame import RgbdFrame, depth_to_metres
from meslam_core.recordings.images import to_rgb
from meslam_core.recordings.messages import MessageSource
from meslam_core.recordings.pairing import ordered_pairs
from meslam_core.recordings.playback import (
    Playback,
    StreamImage,
    check_opens,
    stamp_of_milliseconds,
)

_STREAM_TOPIC = re.compile(r"/device_\d+/sensor_\d+/(Color|Depth)_\d+/image/")
_TIMESTAMP = re.compile(rb"(?:^|[;\x00])timestamp=([0-9.]+)")

MAX_STAMP_NS = 1 << 62

_SAME_STAMP_NS = 2000
"""Stamps of index and playback agree to the rounding of a double."""

logger = logging.getLogger(__name__)


def is_librealsense(source: MessageSource) -> bool:
    """Whether librealsense's recorder wrote a bag, judging by its topics."""
    return any(topic.startswith("/device_0/sensor_") for topic in source.types)


class LibrealsenseRecording:
    """A librealsense file: played by pyrealsense2 as fast as it is read, depth registered here."""

    def __init__(
        self, path: Path, source: MessageSource, camera: PinholeCamera | None = None
    ) -> None:
        """Read the calibration.

        Args:
            path: of the file.
            source: its raw messages, for the index; closed by `close`.
            camera: intrinsics that replace those of the colour camera.

        Raises:
            RecordingError: when pyrealsense2 is missing, or the file is damaged or lacks a stream.
        """
        self.name = path.name
        self.path = path
        self.format = f"librealsense {path.suffix.lstrip('.')}"
        self._source = source
        self._topics = self._image_topics()
        self.topics = {kind: topics["data"] for kind, topics in self._topics.items()}
        check_opens(path)
        self._calibration = Playback(path).calibration()
        self._camera = camera or self._calibration.color

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of the colour camera."""
        return self._camera

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the colour images [ns], increasing."""
        return self._index[0]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """Decode the pairs `start:stop:step`; see `Recording.frames`."""
        numbers = range(len(self))[start:stop:step]
        if not numbers:
            return
        color_ns, depth_ns = self._index
        stamps = {"color": color_ns[list(numbers)], "depth": depth_ns[list(numbers)]}

        def position(stream: str, stamp_ns: int) -> int | None:
            """Which of the wanted pairs an image belongs to."""
            near = stamps[stream]
            place = int(np.searchsorted(near, stamp_ns - _SAME_STAMP_NS))
            found = place < len(near) and near[place] <= stamp_ns + _SAME_STAMP_NS
            return place if found else None

        delivered = 0
        waiting: dict[int, dict[str, StreamImage]] = {}

        def wanted(stream: str, stamp_ns: int) -> bool:
            return position(stream, stamp_ns) is not None

        with closing(Playback(self.path).images(wanted)) as images:
            for image in images:
                place = position(image.stream, image.stamp_ns)
                if place is None:
                    continue
                waiting.setdefault(place, {})[image.stream] = image
                if len(waiting[place]) < 2:
                    continue
                pair = waiting.pop(place)
                # Each stream comes in order, so what is older can have no partner any more.
                waiting = {other: images for other, images in waiting.items() if other > place}
                delivered += 1
                yield self._frame(numbers[place], pair["color"], pair["depth"])
                if place == len(numbers) - 1:
                    break
        if delivered < len(numbers):
            raise RecordingError(
                f"{self.path}: librealsense delivered {delivered} of {len(numbers)} frames; "
                "the file is damaged"
            )

    def close(self) -> None:
        """Release the file; idempotent."""
        self._source.close()

    def _frame(self, number: int, color: StreamImage, depth: StreamImage) -> RgbdFrame:
        calibration = self._calibration
        assert color.pixels is not None
        assert depth.pixels is not None
        try:
            depth_m = depth_to_metres(depth.pixels, depth.depth_scale_m)
            depth_m = register_depth_to_color(
                calibration.depth_lens.undistort_depth(depth_m),
                calibration.depth,
                self._camera,
                calibration.T_color_depth,
            )
            rgb = calibration.color_lens.undistort_color(to_rgb(color.pixels, color.encoding))
            return RgbdFrame(int(self.stamps_ns[number]), rgb, depth_m, self._camera)
        except (FrameError, RecordingError) as error:
            raise RecordingError(f"{self.path}, frame {number}: {error}") from error

    def _image_topics(self) -> dict[str, dict[str, str]]:
        """The topics of each stream's images ("data") and their metadata ("metadata")."""
        found: dict[str, dict[str, str]] = {}
        for topic in sorted(self._source.types):
            match = _STREAM_TOPIC.match(topic)
            if match is None:
                continue
            kind = topic[match.end() :].partition("/")[0]
            found.setdefault(match[1].lower(), {}).setdefault(kind, topic)
        for stream in ("color", "depth"):
            if "data" not in found.get(stream, {}):
                raise RecordingError(
                    f"{self.path} has no {stream} images; record colour and depth together"
                )
        return {stream: found[stream] for stream in ("color", "depth")}

    @cached_property
    def _index(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Stamps [ns] of the colour and of the depth image of every pair."""
        color_ns, depth_ns = self._stream_stamps("color"), self._stream_stamps("depth")
        pairs = np.array(ordered_pairs(self.name, color_ns, depth_ns), np.int64)
        return color_ns[pairs[:, 0]], depth_ns[pairs[:, 1]]

    def _stream_stamps(self, stream: str) -> NDArray[np.int64]:
        topics = self._topics[stream]
        if self.path.suffix == ".bag":
            stamps = [self._source.stamp_ns(raw) for _, _, raw in self._messages(topics["data"])]
        else:
            # The images of a .db3 carry the time of capture, the metadata that of the camera.
            metadata = self._messages(topics.get("metadata", topics["data"]))
            stamps = [self._metadata_stamp(raw) for _, _, raw in metadata]
        if not all(abs(stamp) <= MAX_STAMP_NS for stamp in stamps):
            raise RecordingError(
                f"{self.path}: a {stream} image has a stamp that is no time; record it again"
            )
        return np.array([stamp_of_milliseconds(stamp / 1e6) for stamp in stamps], np.int64)

    def _messages(self, topic: str) -> Iterator[tuple[str, int, bytes]]:
        return self._source.messages([topic])

    def _metadata_stamp(self, raw: bytes) -> int:
        match = _TIMESTAMP.search(raw)
        try:
            return round(float(match[1] if match else "none") * 1e6)
        except (ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.path}: an image has no timestamp in its metadata; record it again"
            ) from error
