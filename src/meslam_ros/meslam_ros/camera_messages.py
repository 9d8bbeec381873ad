"""What a RealSense camera sends as ROS messages: images, camera_info and frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from meslam_core import se3
from meslam_core.camera import T_BODY_OPTICAL
from meslam_core.recordings.playback import pinhole
from meslam_ros.conversions import camera_to_info, image_message, to_stamp, to_transform
from meslam_ros.realsense_camera import CameraImages

PLUMB_BOB_COEFFICIENTS = 5
EQUIDISTANT_COEFFICIENTS = 4


class CameraFrames:
    """Names of a camera's frames, and how they lie to each other, as realsense2_camera has them.

    Args:
        camera_name: that the names begin with.
    """

    def __init__(self, camera_name: str) -> None:
        self.link = f"{camera_name}_link"
        self.depth = f"{camera_name}_depth_frame"
        self.depth_optical = f"{camera_name}_depth_optical_frame"
        self.color = f"{camera_name}_color_frame"
        self.color_optical = f"{camera_name}_color_optical_frame"

    def transforms(self, T_depth_color: se3.Pose) -> TFMessage:
        """The chains from the link, which is where the depth camera is, to both optical frames.

        Args:
            T_depth_color: (4, 4) [m] between the optical frames, from the camera's calibration.
        """
        T_link_color = T_BODY_OPTICAL @ T_depth_color @ se3.inverse(T_BODY_OPTICAL)
        chain = (
            (np.eye(4), self.link, self.depth),
            (T_BODY_OPTICAL, self.depth, self.depth_optical),
            (T_link_color, self.link, self.color),
            (T_BODY_OPTICAL, self.color, self.color_optical),
        )
        stamp = to_stamp(0)
        return TFMessage(transforms=[to_transform(T, stamp, *names) for T, *names in chain])


class CameraMessages:
    """Messages of the pairs of one opened camera.

    Args:
        frames: names of its frames.
        intrinsics: of the colour stream, as librealsense gives them.
    """

    def __init__(self, frames: CameraFrames, intrinsics: Any) -> None:
        self._frame_id = frames.color_optical
        self._camera = pinhole(intrinsics)
        # As realsense2_camera: the inverse Brown-Conrady model of a D400 is passed off as plumb
        # bob; its coefficients are zero or nearly so.
        fisheye = intrinsics.model.name == "kannala_brandt4"
        self._model = "equidistant" if fisheye else "plumb_bob"
        count = EQUIDISTANT_COEFFICIENTS if fisheye else PLUMB_BOB_COEFFICIENTS
        self._coefficients = [float(value) for value in intrinsics.coeffs[:count]]

    def info(self, pair: CameraImages) -> CameraInfo:
        """Of the colour image; it holds for the aligned depth image too."""
        message = camera_to_info(self._camera, to_stamp(pair.stamp_ns), self._frame_id)
        message.distortion_model = self._model
        message.d = self._coefficients
        return message

    def color(self, pair: CameraImages) -> Image:
        """The rgb8 image."""
        return image_message(pair.color, "rgb8", to_stamp(pair.stamp_ns), self._frame_id)

    def depth(self, pair: CameraImages) -> Image:
        """The aligned depth image, 16UC1 in millimetres."""
        return image_message(pair.depth_mm, "16UC1", to_stamp(pair.stamp_ns), self._frame_id)
