"""What a camera and a player of recordings have in common: image pairs that a thread sends."""

from __future__ import annotations

import threading
import traceback

from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from meslam_core.errors import MeslamError
from meslam_ros import topics
from meslam_ros.managed_node import USAGE_ERROR, ManagedNode
from meslam_ros.qos import images


class StoppedError(Exception):
    """The node is being stopped."""


class ImageSource(ManagedNode):
    """Publishes colour, depth and their camera_infos; `send_images` of a subclass does the work.

    What `send_images` raises, and its end, end the node: a `MeslamError` with a message.
    """

    def send_images(self) -> None:
        """Send image pairs, in a thread of its own; `wait` raises when it must end."""

    def open_publishers(self, depth: int) -> None:
        """Offer the four topics, reliably, as realsense2_camera does."""
        profile = images(ReliabilityPolicy.RELIABLE, depth)
        self._color = self.create_publisher(Image, topics.COLOR, profile)
        self._depth = self.create_publisher(Image, topics.DEPTH, profile)
        self._color_info = self.create_publisher(CameraInfo, topics.COLOR_INFO, profile)
        self._depth_info = self.create_publisher(CameraInfo, topics.DEPTH_INFO, profile)

    def close_publishers(self) -> None:
        """Withdraw the topics."""
        for publisher in self.image_publishers:
            self.destroy_publisher(publisher)

    @property
    def image_publishers(self) -> tuple[Publisher, Publisher, Publisher, Publisher]:
        """Of colour, depth, the camera_info of colour and that of depth."""
        return self._color, self._depth, self._color_info, self._depth_info

    def publish_pair(self, info: CameraInfo, color: Image, depth: Image) -> None:
        """Send a pair; one camera_info holds for both images."""
        self._color_info.publish(info)
        self._depth_info.publish(info)
        self._color.publish(color)
        self._depth.publish(depth)

    def begin(self) -> None:
        """Start the thread."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=self.get_name(), daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop the thread, and wait for its end."""
        self._stopping.set()
        self._thread.join()

    def wait(self, seconds: float) -> None:
        """Sleep in the thread.

        Raises:
            StoppedError: when the node is being stopped.
        """
        if self._stopping.wait(seconds):
            raise StoppedError

    def _run(self) -> None:
        try:
            self.send_images()
        except StoppedError:
            return
        except MeslamError as error:
            self.exit_code = USAGE_ERROR
            self.get_logger().error(str(error))
        except Exception:
            self.exit_code = 1
            self.get_logger().fatal(traceback.format_exc())
        self.stop()
