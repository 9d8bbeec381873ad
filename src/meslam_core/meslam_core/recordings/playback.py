"""Plays a librealsense file through pyrealsense2, frame by frame and never waiting for ever."""

from __future__ import annotations

import atexit
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core import se3
from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError, RecordingError
from meslam_core.recordings.lens import Lens

SILENCE_S = 10.0
"""Playback that delivers nothing for so long has failed [s]."""
_DRAINING_S = 2.0
_QUEUED_FRAMES = 8

_LENS_MODELS = {"brown_conrady": "plumb_bob", "kannala_brandt4": "equidistant"}


PROBE_S = 120.0
"""Opening a file takes a second, on a busy computer some more [s]."""
PROBE_CPU_S = 15
"""Some damaged files keep librealsense busy for ever [s of processor time]."""
_PROBE = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[2]), int(sys.argv[2])))
import pyrealsense2 as rs
try:
    device = rs.context().load_device(sys.argv[1])
    profiles = [p for sensor in device.query_sensors() for p in sensor.get_stream_profiles()]
    images = [p for p in profiles if p.stream_type() in (rs.stream.color, rs.stream.depth)]
    for profile in images:
        profile.as_video_stream_profile().get_intrinsics()
        profile.get_extrinsics_to(images[0])
except RuntimeError as error:
    sys.stderr.write(str(error))
    sys.stderr.flush()
    os._exit(1)
os._exit(0)
"""


@dataclass(frozen=True)
class Calibration:
    """Cameras and lenses of both streams; T_color_depth (4, 4) [m]."""

    color: PinholeCamera
    color_lens: Lens
    depth: PinholeCamera
    depth_lens: Lens
    T_color_depth: se3.Pose


@dataclass(frozen=True)
class StreamImage:
    """One image of one stream; `pixels` is None when it was not wanted."""

    stream: str
    stamp_ns: int
    pixels: NDArray[Any] | None
    encoding: str
    depth_scale_m: float


def check_opens(path: Path) -> None:
    """Open a file in a process of its own: librealsense crashes on some that are damaged.

    Raises:
        RecordingError: when pyrealsense2 is not installed, or the file cannot be opened.
    """
    _pyrealsense2(path)
    command = [sys.executable, "-c", _PROBE, str(path), str(PROBE_CPU_S)]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=PROBE_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise RecordingError(
            f"librealsense cannot read {path}: it does not come to an end. The file is damaged, or "
            "the computer has no time for it"
        ) from error
    if done.returncode:
        told = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        endless = -done.returncode in (signal.SIGXCPU, signal.SIGKILL)
        reason = "it does not come to an end" if endless else "it crashes"
        reason = told if done.returncode > 0 and told else reason
        raise RecordingError(
            f"librealsense cannot read {path}: {reason}. The file is damaged, or newer than the "
            "installed pyrealsense2"
        )


class Playback:
    """The colour and the depth stream of a librealsense file.

    Frames come from the sensors themselves: librealsense's pipeline drops the first ones while it
    starts, and its synchroniser repeats or drops others.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            RecordingError: when pyrealsense2 is not installed or cannot read the file.
        """
        self._rs = _pyrealsense2(path)
        self._path = path
        try:
            self._device = self._rs.context().load_device(str(path))
            self._device.as_playback().set_real_time(False)
            self._find_streams()
        except RuntimeError as error:
            raise RecordingError(
                f"librealsense cannot read {path}: {error}. It is damaged, or newer than the "
                "installed pyrealsense2"
            ) from error
        missing = {"color", "depth"} - set(self._profiles)
        if missing:
            raise RecordingError(
                f"{path} has no {' and no '.join(sorted(missing))} stream; "
                "record colour and depth together"
            )

    def _find_streams(self) -> None:
        """Find the first colour and depth stream; a D405 has both in one sensor."""
        self._kinds = {self._rs.stream.color: "color", self._rs.stream.depth: "depth"}
        self._profiles: dict[str, Any] = {}
        self._sensors: list[tuple[Any, list[Any]]] = []
        for sensor in self._device.query_sensors():
            opened = []
            for profile in sensor.get_stream_profiles():
                kind = self._kinds.get(profile.stream_type())
                if kind is not None and kind not in self._profiles:
                    self._profiles[kind] = profile
                    opened.append(profile)
            if opened:
                self._sensors.append((sensor, opened))

    def calibration(self) -> Calibration:
        """Intrinsics and extrinsics.

        Raises:
            RecordingError: when the file has none.
        """
        color, depth = self._profiles["color"], self._profiles["depth"]
        try:
            extrinsics = depth.get_extrinsics_to(color)
            color_camera, color_lens = _camera(color)
            depth_camera, depth_lens = _camera(depth)
        except (RuntimeError, FrameError) as error:
            raise RecordingError(
                f"{self._path} has no calibration: {error}; "
                "record it again with the RealSense tools"
            ) from error
        return Calibration(
            color_camera, color_lens, depth_camera, depth_lens, pose_of_extrinsics(extrinsics)
        )

    def images(self, wanted: Callable[[str, int], bool]) -> Generator[StreamImage, None, None]:
        """All images of both streams, each stream in order; once only.

        Args:
            wanted: tells by stream ("color" or "depth") and stamp [ns] which pixels are needed.

        Raises:
            RecordingError: when playback fails or falls silent.
        """
        events: queue.Queue[StreamImage | Exception] = queue.Queue(_QUEUED_FRAMES)
        ended = threading.Event()

        def put(event: StreamImage | Exception) -> None:
            # A full queue holds librealsense back, so memory does not grow with the recording.
            while not ended.is_set():
                with suppress(queue.Full):
                    events.put(event, timeout=0.1)
                    return

        def receive(frame: Any) -> None:
            if ended.is_set():
                return
            try:
                stream = self._kinds[frame.get_profile().stream_type()]
                put(_stream_image(stream, frame, wanted))
            except Exception as error:
                put(error)

        def shut_down() -> None:
            ended.set()
            # librealsense crashes when its thread reads on while the file is closed.
            with suppress(RuntimeError):
                self._device.as_playback().pause()
            for sensor, _ in self._sensors:
                with suppress(RuntimeError):
                    sensor.stop()
                with suppress(RuntimeError):
                    sensor.close()

        # A thread of librealsense that enters Python while Python exits aborts the process.
        atexit.register(shut_down)
        try:
            self._start(receive)
            yield from self._drain(events)
        finally:
            shut_down()
            atexit.unregister(shut_down)

    def _start(self, receive: Callable[[Any], None]) -> None:
        try:
            for sensor, profiles in self._sensors:
                sensor.open(profiles)
            # Playback begins with the first sensor and would drop frames of those not started yet.
            self._device.as_playback().pause()
            for sensor, _ in self._sensors:
                sensor.start(receive)
            self._device.as_playback().resume()
        except RuntimeError as error:
            raise RecordingError(
                f"librealsense cannot play {self._path}: {error}; "
                "record it again, or restore a copy"
            ) from error

    def _drain(self, events: queue.Queue[StreamImage | Exception]) -> Iterator[StreamImage]:
        playback = self._device.as_playback()
        silent_since = time.monotonic()
        while True:
            # Read before the queue: what was delivered before the end is then in the queue.
            stopped = playback.current_status() == self._rs.playback_status.stopped
            try:
                event = events.get(timeout=_DRAINING_S)
            except queue.Empty:
                if stopped:
                    return
                if time.monotonic() - silent_since > SILENCE_S:
                    raise RecordingError(
                        f"librealsense fell silent for {SILENCE_S:.0f} s while playing "
                        f"{self._path}; the file is damaged"
                    ) from None
                continue
            if isinstance(event, Exception):
                raise RecordingError(
                    f"{self._path} is damaged: {event}; record it again, or restore a copy"
                ) from event
            yield event
            silent_since = time.monotonic()


def stamp_of_milliseconds(milliseconds: float) -> int:
    """Stamp [ns], to the microsecond: librealsense keeps time in floating-point milliseconds."""
    return round(milliseconds * 1e3) * 1000


def pose_of_extrinsics(extrinsics: Any) -> se3.Pose:
    """The (4, 4) pose [m] that librealsense's extrinsics mean."""
    pose = np.eye(4)
    # librealsense writes rotations column by column.
    pose[:3, :3] = np.asarray(extrinsics.rotation).reshape(3, 3).T
    pose[:3, 3] = extrinsics.translation
    return pose


def _stream_image(stream: str, frame: Any, wanted: Callable[[str, int], bool]) -> StreamImage:
    stamp_ns = stamp_of_milliseconds(frame.get_timestamp())
    if not wanted(stream, stamp_ns):
        return StreamImage(stream, stamp_ns, None, "", 0.0)
    video = frame.as_video_frame()
    # librealsense reuses the buffer.
    pixels = np.array(video.get_data())
    if stream == "depth":
        return StreamImage(stream, stamp_ns, pixels, "", frame.as_depth_frame().get_units())
    pixels = pixels.view(np.uint8).reshape(video.get_height(), video.get_width(), -1)
    name = video.get_profile().format().name
    return StreamImage(stream, stamp_ns, pixels, {"y8": "mono8"}.get(name, name), 0.0)


def pinhole(intrinsics: Any) -> PinholeCamera:
    """The camera that librealsense's intrinsics mean, its lens left aside."""
    return PinholeCamera(
        intrinsics.width,
        intrinsics.height,
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.ppx,
        intrinsics.ppy,
    )


def _camera(profile: Any) -> tuple[PinholeCamera, Lens]:
    intrinsics = profile.as_video_stream_profile().get_intrinsics()
    camera = pinhole(intrinsics)
    model = _LENS_MODELS.get(intrinsics.model.name, intrinsics.model.name)
    return camera, Lens(camera, model, intrinsics.coeffs)


def _pyrealsense2(path: Path) -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise RecordingError(
            f"{path} was written by librealsense's recorder, which needs pyrealsense2 to be read: "
            "`pip install pyrealsense2`, or where there is no such package (ARM), convert the file "
            "on another computer with `meslam convert`"
        ) from error
    return pyrealsense2
