"""The choice of topics by name, type and encoding."""

from __future__ import annotations

import pytest

from meslam_core.errors import ConfigError, RecordingError
from meslam_core.recordings.topics import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPE,
    ImageTopic,
    RecordingTopics,
    choose_topics,
)


def chosen(*topics: tuple[str, str]) -> tuple[str, str, str | None, str | None]:
    """Color, depth and their infos; every image topic is given as (name, encoding)."""
    images = [
        ImageTopic(name, encoding, name.rpartition("/")[2].startswith("compressed"))
        for name, encoding in topics
    ]
    types = {image.name: IMAGE_TYPE for image in images}
    types |= {name.partition("/image")[0] + "/camera_info": CAMERA_INFO_TYPE for name, _ in topics}
    result = choose_topics("bag", images, types, RecordingTopics())
    return result.color, result.depth, result.color_info, result.depth_info


@pytest.mark.parametrize(
    ("topics", "color", "depth"),
    [
        pytest.param(
            [
                ("/camera/camera/color/image_raw", "rgb8"),
                ("/camera/camera/depth/image_rect_raw", "16UC1"),
                ("/camera/camera/aligned_depth_to_color/image_raw", "16UC1"),
                ("/camera/camera/infra1/image_rect_raw", "mono8"),
                ("/camera/camera/color/image_raw/compressed", "rgb8"),
            ],
            "/camera/camera/color/image_raw",
            "/camera/camera/aligned_depth_to_color/image_raw",
            id="realsense2_camera",
        ),
        pytest.param(
            [
                ("/camera/color/image_raw", "rgb8"),
                ("/camera/aligned_depth_to_color/image_raw", "16UC1"),
                ("/camera/depth/image_rect_raw", "16UC1"),
            ],
            "/camera/color/image_raw",
            "/camera/aligned_depth_to_color/image_raw",
            id="older realsense2_camera",
        ),
        pytest.param(
            [("/camera/rgb/image_color", "bgr8"), ("/camera/depth/image", "32FC1")],
            "/camera/rgb/image_color",
            "/camera/depth/image",
            id="TUM's Kinect",
        ),
        pytest.param(
            [
                ("/oak/rgb/image_raw", "bgr8"),
                ("/oak/left/image_raw", "mono8"),
                ("/oak/right/image_raw", "mono8"),
                ("/oak/stereo/image_raw", "16UC1"),
            ],
            "/oak/rgb/image_raw",
            "/oak/stereo/image_raw",
            id="another camera",
        ),
        pytest.param(
            [
                ("/camera/camera/color/image_raw/compressed", "rgb8"),
                ("/camera/camera/aligned_depth_to_color/image_raw/compressedDepth", "16UC1"),
                ("/camera/camera/aligned_depth_to_color/image_raw/compressed", "16UC1"),
            ],
            "/camera/camera/color/image_raw/compressed",
            "/camera/camera/aligned_depth_to_color/image_raw/compressedDepth",
            id="compressed",
        ),
    ],
)
def test_choice(topics: list[tuple[str, str]], color: str, depth: str) -> None:
    found_color, found_depth, color_info, depth_info = chosen(*topics)
    assert (found_color, found_depth) == (color, depth)
    assert color_info == color.partition("/image")[0] + "/camera_info"
    assert depth_info == depth.partition("/image")[0] + "/camera_info"


def test_order_of_the_topics_does_not_matter() -> None:
    topics = [
        ("/camera/camera/depth/image_rect_raw", "16UC1"),
        ("/camera/camera/color/image_raw", "rgb8"),
        ("/camera/camera/infra1/image_rect_raw", "mono8"),
    ]
    assert chosen(*topics) == chosen(*reversed(topics))


def test_topics_are_named_by_role():
    named = RecordingTopics.from_texts(["color=/left/image", "depth=/depth/image"])
    assert named == RecordingTopics(color="/left/image", depth="/depth/image")
    for wrong in ("colour=/left/image", "/left/image", "depth="):
        with pytest.raises(ConfigError, match=r"ROLE=TOPIC with one of color, depth"):
            RecordingTopics.from_texts([wrong])


def test_several_that_fit_name_the_option():
    with pytest.raises(RecordingError, match=r"--topic color=/left/image"):
        chosen(("/left/image", "rgb8"), ("/right/image", "rgb8"), ("/depth/image", "16UC1"))
