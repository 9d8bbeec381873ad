from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose
from sensor_msgs.msg import CameraInfo, Image

from meslam_core.camera import PinholeCamera
from meslam_core.errors import FrameError
from meslam_core.se3 import exp
from meslam_ros.conversions import (
    byte_array,
    camera_from_info,
    camera_to_info,
    color_image,
    color_message,
    depth_image,
    depth_message,
    from_pose,
    stamp_ns,
    to_pose,
    to_poses,
    to_stamp,
    to_transform,
)

RGB = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3) * 13
TOPIC = "/camera/image"


def image(pixels: np.ndarray, encoding: str, padding: int = 0, big_endian: bool = False) -> Image:
    """An image message of pixels (H, W) or (H, W, C), with bytes after every row."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).reshape(height, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return Image(
        height=height,
        width=width,
        encoding=encoding,
        step=padded.shape[1],
        is_bigendian=big_endian,
        data=byte_array(np.ascontiguousarray(padded)),
    )


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.concatenate([RGB, RGB[..., :1]], axis=-1)),
        ("bgra8", np.concatenate([RGB[..., ::-1], RGB[..., :1]], axis=-1)),
    ],
)
def test_colour_of_every_encoding_is_rgb(encoding: str, pixels: np.ndarray, padding: int) -> None:
    np.testing.assert_array_equal(color_image(image(pixels, encoding, padding), TOPIC), RGB)


def test_grey_images_become_rgb() -> None:
    grey = color_image(image(RGB[..., 0], "mono8"), TOPIC)
    np.testing.assert_array_equal(grey, np.repeat(RGB[..., :1], 3, axis=-1))


def test_yuyv_of_a_d435_keeps_brightness() -> None:
    neutral = np.full((2, 4, 2), 128, np.uint8)
    neutral[..., 0] = 200
    rgb = color_image(image(neutral, "yuv422_yuy2"), TOPIC).astype(int)
    assert np.ptp(rgb, axis=-1).max() <= 2
    assert abs(rgb.mean() - 200) < 30


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("big_endian", [False, True])
def test_integer_depth_is_millimetres(encoding: str, padding: int, big_endian: bool) -> None:
    raw = np.array([[0, 1000], [1234, 65535]], ">u2" if big_endian else "<u2")
    depth = depth_image(image(raw, encoding, padding, big_endian), TOPIC)
    np.testing.assert_allclose(depth, [[0, 1.0], [1.234, 65.535]], atol=1e-6)


def test_float_depth_is_metres_and_what_is_no_number_is_unknown() -> None:
    raw = np.array([[np.nan, np.inf, -1.0, 1.5]], "<f4")
    np.testing.assert_array_equal(depth_image(image(raw, "32FC1"), TOPIC), [[0, 0, 0, 1.5]])


@pytest.mark.parametrize(
    ("convert", "message", "words"),
    [
        (color_image, image(RGB, "bayer_rggb8"), ("bayer_rggb8", "rgb8")),
        (depth_image, image(RGB, "rgb8"), ("rgb8", "16UC1")),
        (depth_image, image(np.zeros((2, 2)), "64FC1"), ("64FC1", "32FC1")),
        (color_image, Image(height=4, width=4, encoding="rgb8", step=12), ("0 bytes",)),
        (color_image, Image(height=4, width=4, encoding="rgb8", step=3), ("rows of 3",)),
    ],
)
def test_unusable_images_are_refused_by_name(convert, message: Image, words: tuple[str]) -> None:
    with pytest.raises(FrameError) as error:
        convert(message, TOPIC)
    assert TOPIC in str(error.value)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_images_survive_being_sent(encoding: str) -> None:
    depth_m = np.array([[0.0, 0.5, 1.234], [2.0, 3.0, 60.0]], np.float32)
    sent = depth_message(depth_m, encoding, Time(sec=1), "camera")
    np.testing.assert_allclose(depth_image(sent, TOPIC), depth_m, atol=5e-4)
    np.testing.assert_array_equal(
        color_image(color_message(RGB, Time(sec=1), "camera"), TOPIC), RGB
    )


def test_depth_beyond_sixteen_bits_is_unknown() -> None:
    far = depth_message(np.array([[70.0]], np.float32), "16UC1", Time(), "camera")
    assert depth_image(far, TOPIC)[0, 0] == 0


def test_camera_survives_being_sent() -> None:
    camera = PinholeCamera(640, 480, 615.0, 616.0, 321.5, 239.25)
    info = camera_to_info(camera, Time(sec=3), "camera")
    assert camera_from_info(info, TOPIC) == camera
    assert info.header.frame_id == "camera"
    assert list(info.p[:4]) == [615.0, 0.0, 321.5, 0.0]


@pytest.mark.parametrize(
    ("k", "word"), [([0.0] * 9, "all zero"), ([-1.0] * 9, "unusable"), ([np.nan] * 9, "unusable")]
)
def test_camera_info_without_intrinsics_is_refused(k: list[float], word: str) -> None:
    with pytest.raises(FrameError, match=word) as error:
        camera_from_info(CameraInfo(width=4, height=4, k=k), TOPIC)
    assert TOPIC in str(error.value)


def test_pose_survives_being_sent() -> None:
    T = exp(np.array([1.0, -2.0, 3.0, 0.3, -0.2, 0.5]))
    np.testing.assert_allclose(from_pose(to_pose(T)), T, atol=1e-12)
    transform = to_transform(T, Time(sec=5), "map", "odom")
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert transform.transform.translation.z == pytest.approx(T[2, 3])


def test_many_poses_are_the_single_ones() -> None:
    twists = np.random.default_rng(0).uniform(-2, 2, (5, 6))
    T = np.array([exp(twist) for twist in twists])
    for message, single in zip(to_poses(T), T, strict=True):
        np.testing.assert_allclose(from_pose(message), single, atol=1e-12)
    assert to_poses(T[:0]) == []


def test_default_pose_is_the_identity_and_nonsense_is_refused() -> None:
    np.testing.assert_array_equal(from_pose(Pose()), np.eye(4))
    bad = Pose()
    bad.position.x = float("nan")
    with pytest.raises(FrameError, match="nan"):
        from_pose(bad)


def test_stamps_keep_every_nanosecond() -> None:
    assert stamp_ns(to_stamp(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789
