"""Cameras that send wrong images or calibrations to running nodes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from data.ros_camera import Messages
from faults.live_graph import Change, LiveGraph
from faults.live_trial import CAMERA_SIDE, WITH_MAP, Disturbance, live, refused
from sensor_msgs.msg import CameraInfo, Image

from meslam_interfaces.msg import TrackingStatus
from meslam_ros.conversions import byte_array, to_stamp

PERIOD_S = 1 / 15
BAD_IMAGES = 3
HUGE = 2**32 - 1
COLOR, DEPTH, INFO = "color/image_raw", "aligned_depth_to_color/image_raw", "camera_info"
REFUSED = "refused with topic and reason, counted; the pose comes back in the same map"
UNTRUSTED = "DEGRADED with the reason, nothing is trained; the pose comes back in the same map"


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Another depth image, of uint16 or of float32 pixels."""

    def apply(messages: Messages) -> None:
        image = messages[2]
        pixels = np.frombuffer(bytes(image.data), "<u2").reshape(image.height, image.width)
        changed = np.ascontiguousarray(change(pixels.copy()))
        image.encoding = "32FC1" if changed.dtype == np.float32 else "16UC1"
        image.step, image.data = changed.nbytes // len(changed), byte_array(changed)

    return apply


def fields(place: int, **values: object) -> Change:
    """Other fields of the camera_info (0), the colour (1) or the depth image (2)."""

    def apply(messages: Messages) -> None:
        for name, value in values.items():
            setattr(messages[place], name, value)

    return apply


def swapped(messages: Messages) -> None:
    for name in ("encoding", "step", "data"):
        color, depth = getattr(messages[1], name), getattr(messages[2], name)
        setattr(messages[1], name, depth)
        setattr(messages[2], name, color)


def half_the_data(messages: Messages) -> None:
    messages[2].data = messages[2].data[: len(messages[2].data) // 2]


def no_pixels(messages: Messages) -> None:
    for image in messages[1:]:
        image.width = image.height = image.step = 0
        image.data = byte_array(b"")


def halved(image: Image) -> None:
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.width, -1)
    small = np.ascontiguousarray(rows[::2, ::2])
    image.height, image.width = small.shape[:2]
    image.step, image.data = small.nbytes // image.height, byte_array(small)


def depth_of_half_the_size(messages: Messages) -> None:
    halved(messages[2])


def cannot_be_used(change: Change, *words: str) -> Disturbance:
    """Images that are refused one by one, by both nodes."""

    def disturb(graph: LiveGraph) -> str:
        seen = refused([graph.track(change) for _ in range(BAD_IMAGES)], *words)
        for node in CAMERA_SIDE:
            graph.reported(node, f"unusable images: {BAD_IMAGES}")
        return seen

    return disturb


def cannot_be_trusted(change: Change, *words: str) -> Disturbance:
    """Images that are well-formed and wrong."""

    def disturb(graph: LiveGraph) -> str:
        seen = refused([graph.track(change) for _ in range(BAD_IMAGES)], *words)
        graph.reported("tracking_node", "state=DEGRADED")
        return seen

    return disturb


def half_the_size_from_now_on(graph: LiveGraph) -> str:
    """The driver is switched to another profile, images and camera_info together, and back."""

    def change(messages: Messages) -> None:
        info = messages[0]
        info.width, info.height = info.width // 2, info.height // 2
        info.k = np.array([65.0, 0.0, 39.5, 0.0, 65.0, 29.5, 0.0, 0.0, 1.0])
        halved(messages[1])
        halved(messages[2])

    answers = [graph.track(change) for _ in range(6)]
    assert answers[-1].state == TrackingStatus.OK, answers[-1].reason
    assert answers[-1].map_id == answers[0].map_id
    return f"tracked in the same map with {answers[-1].frames_tracked} poses"


def no_colour_for_a_while(graph: LiveGraph) -> str:
    """Three seconds of depth alone."""
    before = len(graph.client.statuses)
    for _ in range(45):
        view = graph.view()
        info, _, image = graph.camera.messages(view, to_stamp(view.stamp_ns))
        graph.camera.info.publish(info)
        graph.camera.depth.publish(image)
        graph.wait(PERIOD_S)
    assert len(graph.client.statuses) <= before + 1, "answers without colour"
    graph.logged("tracking_node", "no image pair", "the other stream has stopped")
    graph.track()
    graph.reported("tracking_node", "depth image without partner")
    return "the log names the stream that stopped, and what found no partner is counted"


def no_camera_info(graph: LiveGraph) -> str:
    """The driver's camera_info has another name."""
    sent_well = graph.camera.info
    graph.camera.info = graph.client.node.create_publisher(CameraInfo, "elsewhere/camera_info", 1)
    seen = refused([graph.track() for _ in range(BAD_IMAGES)], "no camera_info has come", INFO)
    graph.camera.info = sent_well
    return seen


def no_base(graph: LiveGraph) -> str:
    """Nobody tells where the camera sits on the robot."""
    status = graph.track_well()
    graph.logged("tracking_node", "/tf_static does not connect", "base_frame")
    return f"{status.frames_tracked} tracked, the optical frame is the base, the log says so"


FAULTS = (
    live(
        "live-camera-info-missing",
        "no camera_info from the start",
        "refused with the topic and what is missing; tracked as soon as it comes",
        no_camera_info,
        CAMERA_SIDE,
        from_start=True,
    ),
    live(
        "live-tf-missing",
        "no transform between the camera and its base",
        "tracked with the optical frame as the base; the log says so and how to mend it",
        no_base,
        CAMERA_SIDE,
        from_start=True,
        mounted=False,
    ),
    live(
        "live-depth-nan",
        "32FC1 depth images of NaN in a live stream",
        UNTRUSTED,
        cannot_be_trusted(depth(lambda mm: np.full(mm.shape, np.nan, np.float32)), "depth"),
    ),
    live(
        "live-depth-zero",
        "depth images of zeros in a live stream",
        UNTRUSTED,
        cannot_be_trusted(depth(np.zeros_like), "depth"),
        CAMERA_SIDE,
    ),
    live(
        "live-depth-saturated",
        "depth images of 65535 in a live stream",
        UNTRUSTED,
        cannot_be_trusted(depth(lambda mm: np.full_like(mm, 65535)), "depth"),
        CAMERA_SIDE,
    ),
    live(
        "live-depth-all-equal",
        "depth images in which all pixels say 1.5 m",
        UNTRUSTED,
        cannot_be_trusted(depth(lambda mm: np.full_like(mm, 1500))),
        CAMERA_SIDE,
    ),
    live(
        "live-depth-tenths-of-millimetres",
        "16UC1 depth in tenths of millimetres in a live stream",
        "DEGRADED, the reason asks for the unit; the pose comes back in the same map",
        cannot_be_trusted(depth(lambda mm: (10 * mm).astype(np.uint16)), "unit"),
        CAMERA_SIDE,
    ),
    live(
        "live-depth-float-millimetres",
        "32FC1 depth in millimetres in a live stream",
        "DEGRADED, the reason names the unit; the pose comes back in the same map",
        cannot_be_trusted(depth(lambda mm: mm.astype(np.float32)), "millimetres taken as metres"),
        CAMERA_SIDE,
    ),
    live(
        "live-swapped-topics",
        "colour on the depth topic and depth on the colour topic",
        REFUSED,
        cannot_be_used(swapped, COLOR, "16UC1"),
        CAMERA_SIDE,
    ),
    live(
        "live-sizes-differ",
        "depth images of half the size, without a camera_info of their own",
        REFUSED,
        cannot_be_used(depth_of_half_the_size, DEPTH, "80x60", "align_depth"),
        CAMERA_SIDE,
    ),
    live(
        "live-wrong-encoding",
        "colour images in bayer_rggb8",
        REFUSED,
        cannot_be_used(fields(1, encoding="bayer_rggb8"), COLOR, "bayer_rggb8", "rgb8"),
        CAMERA_SIDE,
    ),
    live(
        "live-data-too-short",
        "depth images whose data is half as long as height and step say",
        REFUSED,
        cannot_be_used(half_the_data, DEPTH, "19200 bytes"),
        CAMERA_SIDE,
    ),
    live(
        "live-step-lies",
        "colour images that say a row has 4 GB",
        REFUSED,
        cannot_be_used(fields(1, step=HUGE), COLOR, f"rows of {HUGE}"),
        CAMERA_SIDE,
    ),
    live(
        "live-size-lies",
        "images that say they have 18 exapixels",
        REFUSED,
        cannot_be_used(fields(1, width=HUGE, height=HUGE), COLOR, f"{HUGE}x{HUGE}"),
        CAMERA_SIDE,
    ),
    live(
        "live-no-pixels",
        "images of 0 x 0 pixels",
        REFUSED,
        cannot_be_used(no_pixels, COLOR, "0x0"),
        CAMERA_SIDE,
    ),
    live(
        "live-camera-info-nan",
        "camera_info with K of NaN",
        REFUSED,
        cannot_be_used(fields(0, k=np.full(9, np.nan)), INFO, "nan"),
        CAMERA_SIDE,
    ),
    live(
        "live-camera-info-zeros",
        "camera_info with K of zeros, from an uncalibrated driver",
        REFUSED,
        cannot_be_used(fields(0, k=np.zeros(9)), INFO, "all zero"),
        CAMERA_SIDE,
    ),
    live(
        "live-camera-info-huge",
        "camera_info of 18 exapixels with lens distortion, for which a table would be made",
        "refused before memory is taken, counted; the pose comes back in the same map",
        cannot_be_used(
            fields(0, width=HUGE, height=HUGE, d=[0.1, 0.0, 0.0, 0.0, 0.0]), f"{HUGE}x{HUGE}"
        ),
        CAMERA_SIDE,
    ),
    live(
        "live-lens-nan",
        "camera_info whose distortion coefficients are NaN",
        REFUSED,
        cannot_be_used(fields(0, d=[float("nan")] * 5), INFO, "not finite"),
        CAMERA_SIDE,
    ),
    live(
        "live-camera-changes-size",
        "the camera goes over to half the resolution and back in mid-run",
        "tracked in the same map with the new intrinsics",
        half_the_size_from_now_on,
        CAMERA_SIDE,
    ),
    live(
        "live-colour-missing",
        "three seconds without colour images",
        "the log names the stream that stopped; depth without partners is counted",
        no_colour_for_a_while,
        WITH_MAP,
        input_timeout_s=1.0,
    ),
)
