"""Images of a camera as a node takes them: subscribed, paired, converted and registered."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.errors import FrameError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings.lens import Lens
from meslam_core.se3 import Pose
from meslam_ros import topics
from meslam_ros.conversions import camera_from_info, color_image, depth_image
from meslam_ros.diagnostics import counts
from meslam_ros.image_synchronizer import ImagePair, ImageSynchronizer
from meslam_ros.input_silence import InputSilence
from meslam_ros.node_settings import FrameSettings, InputSettings
from meslam_ros.qos import MatchedSubscription, describe
from meslam_ros.transforms import BaseFrame, CameraMount, StaticTransforms

GRAPH_PERIOD_S = 0.2
INFO_TIMEOUT_S = 0.3
SAME_INTRINSICS_PX = 0.5
LOST_PERIOD_S = 10.0
LOST_REMEDY = (
    "load config/fastdds.xml in both programs (FASTRTPS_DEFAULT_PROFILES_FILE), let the camera "
    "send reliably, or give the nodes more processor time"
)
STEADY = Clock(clock_type=ClockType.STEADY_TIME)


@dataclass(frozen=True)
class _Calibration:
    """What the pixels of one camera_info mean."""

    camera: PinholeCamera
    lens: Lens

    @classmethod
    def of(cls, message: CameraInfo, topic: str) -> _Calibration:
        camera = camera_from_info(message, topic)
        try:
            return cls(camera, Lens(camera, message.distortion_model, message.d))
        except FrameError as error:
            raise FrameError(f"{topic}: {error}") from error


class RgbdInput:
    """Colour, depth and camera_info topics of one camera.

    The executor only pairs messages and hands them to `on_pair`; `frame` converts a pair in
    whatever thread asks for it.

    Args:
        node: whose executor listens.
        settings: tolerances and time-outs.
        frames: names of the frames.
        on_pair: called in the executor with every pair.

    Attributes:
        dropped: pairs that could not be converted, by reason.
        pairs: number of pairs so far.
    """

    def __init__(
        self,
        node: Node,
        settings: InputSettings,
        frames: FrameSettings,
        on_pair: Callable[[ImagePair], None],
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self.pairs = 0
        self.transforms = StaticTransforms(node)
        self._node = node
        self._settings = settings
        self._on_pair = on_pair
        self._base = BaseFrame(
            self.transforms, frames.base_frame, frames.transform_timeout_s, node.get_logger().warn
        )
        self._synchronizer = ImageSynchronizer(settings.sync_tolerance_s)
        self._infos: dict[str, CameraInfo] = {}
        self._calibrations: dict[str, tuple[CameraInfo, _Calibration]] = {}
        self._color = MatchedSubscription(node, Image, topics.COLOR, self._take_color)
        self._depth = MatchedSubscription(node, Image, topics.DEPTH, self._take_depth)
        self._color_info = MatchedSubscription(
            node, CameraInfo, topics.COLOR_INFO, lambda m: self._infos.__setitem__("color", m)
        )
        self._depth_info = MatchedSubscription(
            node, CameraInfo, topics.DEPTH_INFO, lambda m: self._infos.__setitem__("depth", m)
        )
        self._subscriptions = (self._color, self._depth, self._color_info, self._depth_info)
        self._silence = InputSilence(
            node, self._color, self._depth, self._color_info, self._synchronizer, settings
        )
        self._lost = 0
        self._timer = node.create_timer(GRAPH_PERIOD_S, self._watch, clock=STEADY)

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            subscription.close()
        self.transforms.close()

    @property
    def losses(self) -> Counter[str]:
        """Images that were not used, by reason."""
        return +(self._synchronizer.dropped + self.dropped)

    @property
    def lost(self) -> Counter[str]:
        """Images that were sent and did not arrive, by kind."""
        return +Counter(
            {
                "colour images lost on the way": self._color.lost,
                "depth images lost on the way": self._depth.lost,
            }
        )

    def mount(self, pair: ImagePair) -> CameraMount | None:
        """Where the pair's camera sits on the base; None while /tf_static may still tell.

        Raises:
            FrameError: when the images name no frame.
        """
        return self._base.resolve(pair.color.header.frame_id)

    def frame(self, pair: ImagePair) -> RgbdFrame:
        """A pair as the core wants it: pinhole images, depth registered to colour.

        Raises:
            FrameError: naming the topic and what is wrong with it.
        """
        color_info = self._calibration("color", self._color_info.topic)
        color = color_image(pair.color, self._color.topic)
        depth_m = depth_image(pair.depth, self._depth.topic)
        camera = color_info.camera
        if color.shape[:2] != (camera.height, camera.width):
            raise FrameError(
                f"{self._color.topic} has {color.shape[1]}x{color.shape[0]} images, its "
                f"camera_info says {camera.width}x{camera.height}; publish the one that belongs to "
                "these images"
            )
        if self._is_registered(pair, depth_m.shape, camera):
            depth_m = color_info.lens.undistort_depth(depth_m)
        else:
            depth_m = self._registered(pair, depth_m, camera)
        return RgbdFrame(pair.stamp_ns, color_info.lens.undistort_color(color), depth_m, camera)

    def _calibration(self, kind: str, topic: str) -> _Calibration:
        """The latest usable camera_info; images may arrive a moment before theirs."""
        deadline = time.monotonic() + INFO_TIMEOUT_S
        while True:
            try:
                return self._latest_calibration(kind, topic)
            except FrameError:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.01)

    def _latest_calibration(self, kind: str, topic: str) -> _Calibration:
        message = self._infos.get(kind)
        if message is None:
            raise FrameError(
                f"no camera_info has come on {topic} ({describe(self._publishers(topic))}); "
                "the images cannot be used without intrinsics"
            )
        known = self._calibrations.get(kind)
        if known is None or not _same_info(known[0], message):
            known = message, _Calibration.of(message, topic)
            self._calibrations[kind] = known
        return known[1]

    def _is_registered(
        self, pair: ImagePair, shape: tuple[int, ...], camera: PinholeCamera
    ) -> bool:
        if pair.depth.header.frame_id != pair.color.header.frame_id:
            return False
        if shape != (camera.height, camera.width):
            return False
        info = self._infos.get("depth")
        return (
            info is None
            or not any(info.k)
            or bool(np.allclose(info.k, camera.matrix.reshape(-1), atol=SAME_INTRINSICS_PX))
        )

    def _registered(
        self, pair: ImagePair, depth_m: np.ndarray, camera: PinholeCamera
    ) -> np.ndarray:
        try:
            depth_info = self._calibration("depth", self._depth_info.topic)
        except FrameError as error:
            raise FrameError(
                f"{self._depth.topic} has {depth_m.shape[1]}x{depth_m.shape[0]} images in the "
                f"frame {pair.depth.header.frame_id!r}, colour is {camera.width}x{camera.height} "
                f"in {pair.color.header.frame_id!r}, and they cannot be registered: {error}; "
                "start the camera with align_depth.enable:=true, or publish the depth's "
                "camera_info"
            ) from error
        if depth_m.shape != (depth_info.camera.height, depth_info.camera.width):
            raise FrameError(
                f"{self._depth.topic} has {depth_m.shape[1]}x{depth_m.shape[0]} images, its "
                f"camera_info says {depth_info.camera.width}x{depth_info.camera.height}; publish "
                "the one that belongs to these images"
            )
        return register_depth_to_color(
            depth_info.lens.undistort_depth(depth_m),
            depth_info.camera,
            camera,
            self._extrinsics(pair),
        )

    def _extrinsics(self, pair: ImagePair) -> Pose:
        color_frame, depth_frame = pair.color.header.frame_id, pair.depth.header.frame_id
        if color_frame == depth_frame:
            return np.eye(4)
        T_color_depth = self.transforms.lookup(color_frame, depth_frame)
        if T_color_depth is None:
            raise FrameError(
                f"depth is in the frame {depth_frame!r}, colour in {color_frame!r}, and "
                "/tf_static does not connect them; publish the transform, or start the camera "
                f"with align_depth.enable:=true{self.transforms.complaint()}"
            )
        return T_color_depth

    def _take_color(self, message: Image) -> None:
        for pair in self._synchronizer.add_color(message):
            self._hand_over(pair)

    def _take_depth(self, message: Image) -> None:
        for pair in self._synchronizer.add_depth(message):
            self._hand_over(pair)

    def _hand_over(self, pair: ImagePair) -> None:
        self.pairs += 1
        self._silence.heard()
        self._on_pair(pair)

    def _watch(self) -> None:
        self._synchronizer.tolerance_s = self._settings.sync_tolerance_s
        for subscription in self._subscriptions:
            subscription.update()
        self._silence.watch()
        lost = self.lost.total()
        if lost > self._lost:
            self._lost = lost
            self._node.get_logger().warn(
                f"{counts(self.lost)}; {LOST_REMEDY}", throttle_duration_sec=LOST_PERIOD_S
            )

    def _publishers(self, topic: str) -> list:
        return self._node.get_publishers_info_by_topic(topic)


def _same_info(first: CameraInfo, second: CameraInfo) -> bool:
    return (
        (first.width, first.height) == (second.width, second.height)
        and np.array_equal(first.k, second.k)
        and np.array_equal(first.d, second.d)
        and first.distortion_model == second.distortion_model
    )
