"""A RealSense camera through pyrealsense2: opened, streamed, its depth aligned to colour."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meslam_core.errors import ConfigError, MeslamError
from meslam_core.recordings.playback import pose_of_extrinsics, stamp_of_milliseconds
from meslam_core.se3 import Pose
from meslam_ros.node_settings import CameraSettings

MILLIMETRE = 0.001
MILLISECONDS = 1000

Devices = Callable[[], Iterable[Any]]


class CameraError(MeslamError):
    """A camera that cannot do what it is asked for; asking again does not help."""


class CameraLostError(MeslamError):
    """A camera that is not there any more, or that another program holds."""


@dataclass(frozen=True)
class StreamFormat:
    """Size and rate of one stream, as realsense2_camera writes them: 640x480x15."""

    width: int
    height: int
    fps: int

    @classmethod
    def parse(cls, text: str, name: str) -> StreamFormat:
        """Read WIDTHxHEIGHTxFPS.

        Raises:
            ConfigError: naming the parameter.
        """
        numbers = text.lower().split("x")
        if len(numbers) != 3 or not all(n.isdecimal() and int(n) > 0 for n in numbers):
            raise ConfigError(f"{name} = {text!r}: expected WIDTHxHEIGHTxFPS, such as 640x480x15")
        return cls(*(int(number) for number in numbers))

    def __str__(self) -> str:
        return f"{self.width}x{self.height}x{self.fps}"


@dataclass(frozen=True)
class CameraImages:
    """One pair: colour (H, W, 3) uint8 rgb, depth (H, W) uint16 [mm] aligned to it.

    `stamp_ns` is the colour image's, on this computer's clock.
    """

    stamp_ns: int
    number: int
    color: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]


def librealsense() -> Any:
    """The module pyrealsense2.

    Raises:
        CameraError: where it is not installed.
    """
    try:
        import pyrealsense2
    except ImportError as error:
        raise CameraError(
            f"pyrealsense2 cannot be imported ({error}): `pip install pyrealsense2`, or where "
            "there is no such package (ARM), use realsense2_camera"
        ) from error
    return pyrealsense2


def usb_devices() -> Devices:
    """Lists the RealSense cameras that are plugged in."""
    context = librealsense().context()
    return lambda: list(context.query_devices())


def find_device(devices: Devices, serial_no: str) -> Any | None:
    """The camera with a serial number, or the first one where none is asked for."""
    for device in devices():
        # A camera that is just being unplugged cannot say who it is.
        with suppress(RuntimeError):
            if serial_no in ("", serial_number(device)):
                return device
    return None


def serial_number(device: Any) -> str:
    """Of a device."""
    return device.get_info(librealsense().camera_info.serial_number)


class RealsenseCamera:
    """A camera that streams colour and depth.

    Frames come from the sensors themselves, paired by librealsense's matcher for the camera;
    depth is aligned to colour by librealsense, so that it meets a distorted colour image too.

    Args:
        device: of librealsense.
        settings: what it is asked for.

    Attributes:
        name, serial: of the camera.
        usb: type of its connection ("3.2"), empty where unknown.
        intrinsics: of the colour stream.
        T_depth_color: (4, 4) [m] maps colour-camera to depth-camera coordinates.

    Raises:
        ConfigError: for a stream format that cannot be read.
        CameraError: when it does not have the streams asked for.
        CameraLostError: when it cannot be opened.
    """

    def __init__(self, device: Any, settings: CameraSettings) -> None:
        rs = self._rs = librealsense()
        self._device = device
        self._settings = settings
        self.color_format = StreamFormat.parse(settings.color_profile, "color_profile")
        self.depth_format = StreamFormat.parse(settings.depth_profile, "depth_profile")
        self._started: list[Any] = []
        self._options: tuple[object, ...] = ()
        self._clock_offset_ns: int | None = None
        self._syncer = rs.syncer()
        self._align = rs.align(rs.stream.color)
        try:
            self.name = device.get_info(rs.camera_info.name)
            self.serial = serial_number(device)
            self.usb = self._info(rs.camera_info.usb_type_descriptor)
            color = self._profile(rs.stream.color, rs.format.rgb8, self.color_format)
            depth = self._profile(rs.stream.depth, rs.format.z16, self.depth_format)
            self.intrinsics = color[1].as_video_stream_profile().get_intrinsics()
            self.T_depth_color: Pose = pose_of_extrinsics(color[1].get_extrinsics_to(depth[1]))
            self._color_sensor, self._depth_sensor = color[0], depth[0]
            self._set_options()
            self._start([color, depth])
        except RuntimeError as error:
            self.close()
            raise CameraLostError(
                f"the camera cannot be opened: {error}. Is another program using it, and are "
                "librealsense's udev rules installed?"
            ) from error

    def __enter__(self) -> RealsenseCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __str__(self) -> str:
        usb = f", USB {self.usb}" if self.usb else ""
        return f"{self.name} {self.serial}{usb}"

    @property
    def connected(self) -> bool:
        """Whether librealsense still sees it."""
        try:
            return bool(self._device.is_connected())
        except RuntimeError:
            return False

    def wait(self, timeout_s: float) -> CameraImages | None:
        """The next pair of images; None when none came in time."""
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            came, frames = self._syncer.try_wait_for_frames(max(int(left_s * MILLISECONDS), 1))
            if not came:
                return None
            color, depth = frames.get_color_frame(), frames.get_depth_frame()
            if color and depth:
                aligned = self._align.process(frames).as_frameset().get_depth_frame()
                return CameraImages(
                    self._stamp_ns(color),
                    color.get_frame_number(),
                    np.asanyarray(color.get_data()),
                    _millimetres(np.asanyarray(aligned.get_data()), depth.get_units()),
                )
        return None

    def close(self) -> None:
        """Stop streaming; idempotent, and harmless where the camera has gone."""
        for sensor in self._started:
            with suppress(RuntimeError):
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()
        self._started.clear()

    def _info(self, kind: Any) -> str:
        return self._device.get_info(kind) if self._device.supports(kind) else ""

    def _profile(self, stream: Any, pixels: Any, wanted: StreamFormat) -> tuple[Any, Any]:
        """The sensor that has a stream, and its profile."""
        offered: set[tuple[int, int, int]] = set()
        for sensor in self._device.query_sensors():
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or profile.format() != pixels:
                    continue
                video = profile.as_video_stream_profile()
                size = (video.width(), video.height(), video.fps())
                if size == (wanted.width, wanted.height, wanted.fps):
                    return sensor, profile
                offered.add(size)
        names = ", ".join(str(StreamFormat(*size)) for size in sorted(offered)) or "none"
        raise CameraError(
            f"{self} has no {stream.name} stream {wanted}; it offers: {names}"
            + (" (on USB 3 it offers more)" if self.usb.startswith("2") else "")
        )

    def follow_settings(self) -> None:
        """Set exposure and emitter anew where their settings have changed."""
        if self._options != _options(self._settings):
            # A camera that has just gone cannot be told; `wait` finds out.
            with suppress(RuntimeError):
                self._set_options()

    def _set_options(self) -> None:
        option, settings = self._rs.option, self._settings
        color, depth = self._color_sensor, self._depth_sensor
        self._options = _options(settings)
        automatic = float(settings.auto_exposure)
        wanted = [
            # Stamps on this computer's clock instead of the camera's own.
            (color, option.global_time_enabled, 1.0),
            (depth, option.global_time_enabled, 1.0),
            (color, option.enable_auto_exposure, automatic),
            (depth, option.enable_auto_exposure, automatic),
            # In the dark the rate stays, and with it the pairing with depth.
            (color, option.auto_exposure_priority, 0.0),
            (depth, option.emitter_enabled, float(settings.emitter)),
        ]
        if not settings.auto_exposure and settings.color_exposure:
            wanted.append((color, option.exposure, float(settings.color_exposure)))
        if self._device.is_playback():
            return
        for sensor, name, value in wanted:
            if sensor.supports(name) and not sensor.is_option_read_only(name):
                limits = sensor.get_option_range(name)
                sensor.set_option(name, min(max(value, limits.min), limits.max))

    def _start(self, streams: list[tuple[Any, Any]]) -> None:
        # A D405 has both streams in one sensor, which is opened once.
        sensors: dict[str, tuple[Any, list[Any]]] = {}
        for sensor, profile in streams:
            name = sensor.get_info(self._rs.camera_info.name)
            sensors.setdefault(name, (sensor, []))[1].append(profile)
        for sensor, profiles in sensors.values():
            sensor.open(profiles)
            self._started.append(sensor)
        for sensor, _ in sensors.values():
            sensor.start(self._syncer)

    def _stamp_ns(self, frame: Any) -> int:
        stamp_ns = stamp_of_milliseconds(frame.get_timestamp())
        if frame.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock:
            return stamp_ns
        if self._clock_offset_ns is None:
            self._clock_offset_ns = time.time_ns() - stamp_ns
        return stamp_ns + self._clock_offset_ns


def _options(settings: CameraSettings) -> tuple[object, ...]:
    return settings.auto_exposure, settings.color_exposure, settings.emitter


def _millimetres(depth: NDArray[np.uint16], unit_m: float) -> NDArray[np.uint16]:
    """Depth in millimetres; what does not fit is unknown."""
    scale = unit_m / MILLIMETRE
    if abs(scale - 1.0) < 1e-4:
        return depth
    scaled = np.rint(depth * np.float32(scale))
    scaled[scaled > np.iinfo(np.uint16).max] = 0
    return scaled.astype(np.uint16)
