"""`camera_node`: a RealSense camera without realsense2_camera, on the same topics."""

from __future__ import annotations

import sys
import time
from typing import Any

from tf2_msgs.msg import TFMessage

from meslam_ros import topics
from meslam_ros.camera_messages import CameraFrames, CameraMessages
from meslam_ros.conversions import NANOSECONDS
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, ERROR, OK, WARN, Diagnostics
from meslam_ros.image_source import ImageSource
from meslam_ros.managed_node import USAGE_ERROR, run
from meslam_ros.node_settings import CameraSettings
from meslam_ros.parameters import declare_settings
from meslam_ros.qos import latched
from meslam_ros.realsense_camera import (
    CameraImages,
    CameraLostError,
    Devices,
    RealsenseCamera,
    StreamFormat,
    find_device,
    serial_number,
    usb_devices,
)
from meslam_ros.rgbd_input import STEADY

POLL_S = 0.2
IMAGE_DEPTH = 10
RETRY_S = 1.0
FIRST_REPORT_S = 2.0
LATE_SHARE = 0.8
WARNING_PERIOD_S = 5.0


class CameraNode(ImageSource):
    """Publishes colour, aligned depth, their camera_infos and the camera's frames.

    Args:
        devices: lists librealsense's devices; by default those on USB.
        options: for `rclpy.node.Node`.
    """

    def __init__(self, devices: Devices | None = None, **options: Any) -> None:
        super().__init__("camera_node", **options)
        self._settings = declare_settings(self, CameraSettings)
        self._devices = devices

    def configure(self) -> None:
        self.exit_code = USAGE_ERROR
        StreamFormat.parse(self._settings.color_profile, "color_profile")
        StreamFormat.parse(self._settings.depth_profile, "depth_profile")
        self._frames = CameraFrames(self._settings.camera_name)
        self._found = self._devices or usb_devices()
        self.exit_code = 0
        self.open_publishers(IMAGE_DEPTH)
        self._static = self.create_publisher(TFMessage, topics.TF_STATIC, latched())
        self._diagnostics = Diagnostics(self)

    def activate(self) -> None:
        self._camera: RealsenseCamera | None = None
        self._published = self._missed = self._reconnections = 0
        self._reported = (0, time.monotonic())
        self._last_ns = self._last_number = 0
        self._last_s = time.monotonic()
        self.begin()
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY)

    def deactivate(self) -> None:
        self.destroy_timer(self._timer)
        self.end()

    def cleanup(self) -> None:
        self._diagnostics.close()
        self.destroy_publisher(self._static)
        self.close_publishers()

    def send_images(self) -> None:
        """Stream from the camera whenever it is there (`ImageSource`)."""
        while True:
            device = self._wait_for_device()
            try:
                with RealsenseCamera(device, self._settings) as camera:
                    self._stream(camera)
            except CameraLostError as error:
                self.get_logger().warn(str(error), throttle_duration_sec=WARNING_PERIOD_S)
            finally:
                self._camera = None
            self._reconnections += 1
            self.wait(RETRY_S)

    def _wait_for_device(self) -> Any:
        """The camera, as soon as it is plugged in; says more and more seldom that it is not."""
        started = time.monotonic()
        report_s = FIRST_REPORT_S
        while (device := find_device(self._found, self._settings.serial_no)) is None:
            waited_s = time.monotonic() - started
            if waited_s >= report_s:
                report_s = 2.0 * waited_s
                self.get_logger().warn(f"{self._missing()}; looking for it for {waited_s:.0f} s")
            self.wait(POLL_S)
        return device

    def _missing(self) -> str:
        others = [serial_number(device) for device in self._found()]
        wanted = self._settings.serial_no
        if others:
            return (
                f"no RealSense camera has the serial number {wanted}; connected are "
                f"{', '.join(others)} (quote a number that begins with 0: "
                "-p \"serial_no:='012'\")"
            )
        return (
            "no RealSense camera is connected: plug it in, into a USB 3 port; where `lsusb` shows "
            "it, librealsense's udev rules are missing; in a container, pass /dev/bus/usb"
        )

    def _stream(self, camera: RealsenseCamera) -> None:
        """Publish what a camera sends until it is lost or the node stops."""
        messages = CameraMessages(self._frames, camera.intrinsics)
        if self._settings.publish_tf:
            self._static.publish(self._frames.transforms(camera.T_depth_color))
        self.get_logger().info(
            f"{camera}: colour {camera.color_format}, depth {camera.depth_format} aligned to it"
        )
        if camera.usb.startswith("2"):
            self.get_logger().warn(
                f"the camera is on USB {camera.usb}, which carries small images only; use a "
                "USB 3 port and cable"
            )
        self._camera = camera
        self._last_number = 0
        last_s = time.monotonic()
        while True:
            self.wait(0.0)
            camera.follow_settings()
            pair = camera.wait(POLL_S)
            now = time.monotonic()
            if pair is not None:
                last_s = now
                self._publish(pair, messages)
            elif not camera.connected:
                raise CameraLostError(f"{camera} was unplugged; waiting for it")
            elif now - last_s > self._settings.silence_timeout_s:
                raise CameraLostError(
                    f"{camera} has sent nothing for {now - last_s:.1f} s; it is opened again"
                )

    def _publish(self, pair: CameraImages, messages: CameraMessages) -> None:
        if self._last_number:
            self._missed += max(pair.number - self._last_number - 1, 0)
        self._last_number = pair.number
        if not self._is_later(pair.stamp_ns):
            self._missed += 1
            return
        self.publish_pair(messages.info(pair), messages.color(pair), messages.depth(pair))
        self._published += 1

    def _is_later(self, stamp_ns: int) -> bool:
        """Whether an image follows the last one; the clock may be set back, but not for a moment.

        Whoever tracks takes a jump back for a recording that begins again.
        """
        now, back_s = time.monotonic(), (self._last_ns - stamp_ns) / NANOSECONDS
        if back_s >= 0 and now - self._last_s < self._settings.silence_timeout_s:
            self.get_logger().warn(
                f"the camera's clock went back by {back_s:.3f} s; images are left out",
                throttle_duration_sec=WARNING_PERIOD_S,
            )
            return False
        if back_s >= 0:
            self.get_logger().warn(f"the clock was set back by {back_s:.1f} s; going on with it")
        self._last_ns, self._last_s = stamp_ns, now
        return True

    def _diagnose(self) -> None:
        count, now = self._published, time.monotonic()
        fps = (count - self._reported[0]) / max(now - self._reported[1], 1e-3)
        self._reported = count, now
        camera = self._camera
        level, message = OK, f"{fps:.1f} image pairs a second"
        if camera is None:
            level, message = ERROR, "no camera"
        elif fps < LATE_SHARE * min(camera.color_format.fps, camera.depth_format.fps):
            level, message = WARN, f"only {fps:.1f} image pairs a second come from the camera"
        elif camera.usb.startswith("2"):
            level, message = WARN, f"on USB {camera.usb}"
        self._diagnostics.report(
            level,
            message,
            {
                "camera": camera or "none",
                "image_pairs": count,
                "missed": self._missed,
                "reconnections": self._reconnections,
            },
        )


def main() -> None:
    """Entry point."""
    sys.exit(run(CameraNode))


if __name__ == "__main__":
    main()
