"""A RealSense camera made of librealsense's software device: real sensors, matcher and aligner."""

from __future__ import annotations

import numpy as np
import pyrealsense2 as rs

from meslam_core import se3

WIDTH, HEIGHT, FPS = 64, 48, 15
PERIOD_MS = 1000.0 / FPS
# As on a D435, the depth camera sees more than the colour camera, which is 15 mm beside it.
COLOR_F, DEPTH_F = 60.0, 40.0
T_COLOR_DEPTH = se3.exp(np.array([0.015, -0.002, 0.001, 0.01, -0.02, 0.03]))


class SoftwareCamera:
    """One camera; every one has a serial number of its own.

    Args:
        serial: number.
        unit_m: of depth.
        domain: of the stamps.
        T_color_depth: (4, 4) [m] where the depth camera sits.
        usb: type of the connection.
    """

    def __init__(
        self,
        serial: str = "012345678901",
        unit_m: float = 0.001,
        domain: rs.timestamp_domain = rs.timestamp_domain.system_time,
        T_color_depth: se3.Pose = T_COLOR_DEPTH,
        usb: str = "3.2",
    ) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.device.register_info(rs.camera_info.name, "Software D435")
        self.device.register_info(rs.camera_info.usb_type_descriptor, usb)
        self.intrinsics = _intrinsics(COLOR_F, rs.distortion.inverse_brown_conrady)
        self._unit_m = unit_m
        self._domain = domain
        self._depth_sensor = self.device.add_sensor("Stereo Module")
        self._color_sensor = self.device.add_sensor("RGB Camera")
        self._depth_sensor.add_read_only_option(rs.option.depth_units, unit_m)
        for sensor in (self._color_sensor, self._depth_sensor):
            sensor.add_option(rs.option.enable_auto_exposure, _range(0, 1, 1))
        self._color_sensor.add_option(rs.option.exposure, _range(1, 10000, 156))
        self._depth_sensor.add_option(rs.option.emitter_enabled, _range(0, 2, 1))
        self._depth = self._depth_sensor.add_video_stream(
            _stream(rs.stream.depth, rs.format.z16, 2, _intrinsics(DEPTH_F))
        )
        self._color = self._color_sensor.add_video_stream(
            _stream(rs.stream.color, rs.format.rgb8, 3, self.intrinsics)
        )
        extrinsics = rs.extrinsics()
        extrinsics.rotation = T_color_depth[:3, :3].T.reshape(-1).tolist()
        extrinsics.translation = T_color_depth[:3, 3].tolist()
        self._depth.register_extrinsics_to(self._color, extrinsics)
        self.device.create_matcher(rs.matchers.default)

    def send(
        self,
        number: int,
        stamp_ms: float,
        depth_m: float | np.ndarray = 1.0,
        color: np.ndarray | None = None,
    ) -> None:
        """One pair of images: a wall or (HEIGHT, WIDTH) depths [m], a plain colour or pixels."""
        pixels = np.empty((HEIGHT, WIDTH), np.uint16)
        pixels[:] = np.rint(np.asarray(depth_m) / self._unit_m)
        self._depth_sensor.on_video_frame(self._frame(self._depth, pixels, number, stamp_ms))
        if color is None:
            color = np.full((HEIGHT, WIDTH, 3), number % 256, np.uint8)
        self._color_sensor.on_video_frame(self._frame(self._color, color, number, stamp_ms))

    @property
    def options(self) -> dict[str, float]:
        """How the sensors are set now."""
        color, depth = self._color_sensor, self._depth_sensor
        return {
            "auto_exposure": color.get_option(rs.option.enable_auto_exposure),
            "depth_auto_exposure": depth.get_option(rs.option.enable_auto_exposure),
            "exposure": color.get_option(rs.option.exposure),
            "emitter": depth.get_option(rs.option.emitter_enabled),
        }

    def _frame(
        self, profile: rs.stream_profile, pixels: np.ndarray, number: int, stamp_ms: float
    ) -> rs.software_video_frame:
        frame = rs.software_video_frame()
        frame.pixels = pixels
        frame.stride = pixels.nbytes // HEIGHT
        frame.bpp = frame.stride // WIDTH
        frame.timestamp = stamp_ms
        frame.domain = self._domain
        frame.frame_number = number
        frame.depth_units = self._unit_m
        frame.profile = profile.as_video_stream_profile()
        return frame


def _range(minimum: float, maximum: float, default: float) -> rs.option_range:
    result = rs.option_range()
    result.min, result.max, result.default, result.step = minimum, maximum, default, 1
    return result


def _intrinsics(focal: float, model: rs.distortion = rs.distortion.brown_conrady) -> rs.intrinsics:
    result = rs.intrinsics()
    result.width, result.height = WIDTH, HEIGHT
    result.ppx, result.ppy = WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5
    result.fx, result.fy = focal, focal + 1.0
    result.model = model
    result.coeffs = [0.0] * 5
    return result


def _stream(
    kind: rs.stream, pixels: rs.format, size: int, intrinsics: rs.intrinsics
) -> rs.video_stream:
    result = rs.video_stream()
    result.type, result.fmt, result.bpp = kind, pixels, size
    result.index, result.uid = 0, int(kind)
    result.width, result.height, result.fps = WIDTH, HEIGHT, FPS
    result.intrinsics = intrinsics
    return result
