"""ROS bags in every storage: pairing, order, slices, registration, calibration."""

from __future__ import annotations

import logging
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from data.bag_builder import (
    ALIGNED_DEPTH,
    COLOR,
    COLOR_FRAME,
    COLOR_INFO,
    DEPTH,
    DEPTH_FRAME,
    DEPTH_INFO,
    EXTRINSICS,
    BagBuilder,
    Storage,
    aligned_bag,
)
from data.synthetic_frames import (
    CAMERA,
    START_NS,
    assert_same_frame,
    depth_mm,
    plane_frame,
    plane_frames,
)

from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.errors import RecordingError
from meslam_core.recordings import RecordingTopics, open_recording
from meslam_core.recordings.recording import Recording

DEPTH_CAMERA = PinholeCamera(width=24, height=20, fx=22.0, fy=22.0, cx=11.5, cy=9.5)


@pytest.mark.parametrize("storage", ["folder", "mcap", "db3", "bag"])
def test_every_storage_gives_the_same_frames(tmp_path: Path, storage: Storage) -> None:
    frames = plane_frames(5)
    recording = open_recording(aligned_bag(frames, tmp_path, storage))
    assert isinstance(recording, Recording)
    assert len(recording) == 5
    assert recording.camera == CAMERA
    assert recording.topics["depth"] == ALIGNED_DEPTH
    for _ in range(2):
        for actual, expected in zip(recording.frames(), frames, strict=True):
            assert_same_frame(actual, expected)
            assert actual.color.flags.writeable
    recording.close()
    recording.close()


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_slices(tmp_path: Path, storage: Storage) -> None:
    frames = plane_frames(9)
    recording = open_recording(aligned_bag(frames, tmp_path, storage))
    for cut in ((3, None, 1), (2, 8, 3), (0, 100, 4), (8, 9, 1), (20, None, 1)):
        actual = [frame.stamp_ns for frame in recording.frames(*cut)]
        assert actual == [frame.stamp_ns for frame in frames[slice(*cut)]]


def test_skipped_frames_are_not_decoded(tmp_path: Path) -> None:
    builder = BagBuilder()
    for frame in plane_frames(4):
        builder.aligned_frame(frame)
    damaged = plane_frame(4)
    builder.image(COLOR, damaged.stamp_ns, damaged.color, "unheard of")
    builder.image(ALIGNED_DEPTH, damaged.stamp_ns, depth_mm(damaged), "16UC1")
    builder.aligned_frame(plane_frame(5))
    recording = open_recording(builder.write(tmp_path))
    expected = [plane_frame(number).stamp_ns for number in (3, 5)]
    assert [frame.stamp_ns for frame in recording.frames(3, None, 2)] == expected
    with pytest.raises(RecordingError, match="frame 4"):
        list(recording.frames(4))


def test_time_of_recording_does_not_matter(tmp_path: Path) -> None:
    """Images arrive late, depth before colour, frames out of order; stamps decide."""
    frames = plane_frames(6)
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    arrival = [0, 2, 1, 3, 5, 4]
    for frame, place in zip(frames, arrival, strict=True):
        recorded_ns = START_NS + 10**9 + place * 10**8
        builder.image(COLOR, frame.stamp_ns, frame.color, "rgb8", recorded_ns=recorded_ns)
        builder.image(
            ALIGNED_DEPTH,
            frame.stamp_ns + 3_000_000,
            depth_mm(frame),
            "16UC1",
            recorded_ns=recorded_ns - 2 * 10**8,
        )
    recording = open_recording(builder.write(tmp_path))
    for actual, expected in zip(recording.frames(), frames, strict=True):
        assert_same_frame(actual, expected)
    assert [f.stamp_ns for f in recording.frames(4)] == [f.stamp_ns for f in frames[4:]]


def test_frames_after_a_clock_jump_are_skipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    for number in range(100):
        stamp_ns = START_NS + number * 10**8 if number < 50 else START_NS - (200 - number) * 10**8
        frame, recorded_ns = plane_frame(number), START_NS + number * 10**8
        builder.image(COLOR, stamp_ns, frame.color, "rgb8", recorded_ns=recorded_ns)
        builder.image(ALIGNED_DEPTH, stamp_ns, depth_mm(frame), "16UC1", recorded_ns=recorded_ns)
    with caplog.at_level(logging.WARNING):
        recording = open_recording(builder.write(tmp_path))
        stamps = [frame.stamp_ns for frame in recording.frames()]
    assert stamps == [START_NS + number * 10**8 for number in range(50)]
    assert "skipped 50 frames that come more than" in caplog.text


def test_images_without_stamps_take_the_time_of_recording(tmp_path: Path) -> None:
    builder = BagBuilder()
    for frame in plane_frames(3):
        builder.camera_info(COLOR_INFO, frame.stamp_ns, CAMERA)
        builder.image(COLOR, 0, frame.color, "rgb8", recorded_ns=frame.stamp_ns)
        builder.image(ALIGNED_DEPTH, 0, depth_mm(frame), "16UC1", recorded_ns=frame.stamp_ns)
    recording = open_recording(builder.write(tmp_path))
    for actual, expected in zip(recording.frames(), plane_frames(3), strict=True):
        assert_same_frame(actual, expected)


def compressed_bag(tmp_path: Path) -> Path:
    builder = BagBuilder()
    for frame in plane_frames(3):
        color = cv2.imencode(".png", frame.color[..., ::-1])[1].tobytes()
        depth = bytes(12) + cv2.imencode(".png", depth_mm(frame))[1].tobytes()
        builder.camera_info(COLOR_INFO, frame.stamp_ns, CAMERA)
        builder.compressed(f"{COLOR}/compressed", frame.stamp_ns, "rgb8; png compressed", color)
        builder.compressed(
            f"{ALIGNED_DEPTH}/compressedDepth", frame.stamp_ns, "16UC1; compressedDepth png", depth
        )
    return builder.write(tmp_path)


def test_compressed_topics(tmp_path: Path) -> None:
    recording = open_recording(compressed_bag(tmp_path))
    assert recording.topics["color_info"] == COLOR_INFO
    for actual, expected in zip(recording.frames(), plane_frames(3), strict=True):
        assert_same_frame(actual, expected)


def test_old_names_of_a_ros1_kinect(tmp_path: Path) -> None:
    """As in the TUM benchmark's bags: 32FC1 depth with NaN where nothing was measured."""
    builder = BagBuilder(ros1=True)
    for frame in plane_frames(2):
        depth_m = np.where(frame.depth_m > 0, frame.depth_m, np.nan).astype(np.float32)
        for topic, pixels, encoding in (
            ("/camera/rgb/image_color", frame.color, "rgb8"),
            ("/camera/depth/image", depth_m, "32FC1"),
        ):
            frame_id = "/openni_rgb_optical_frame"
            builder.camera_info(topic.rpartition("/")[0] + "/camera_info", frame.stamp_ns, CAMERA)
            builder.image(topic, frame.stamp_ns, pixels, encoding, frame_id)
    recording = open_recording(builder.write(tmp_path, "bag"))
    for actual, expected in zip(recording.frames(), plane_frames(2), strict=True):
        assert_same_frame(actual, expected)


def unaligned(T_color_depth: np.ndarray) -> tuple[BagBuilder, np.ndarray]:
    """A bag with depth in its own frame, and what registration should give."""
    builder = BagBuilder()
    frame = plane_frame(0)
    v, u = np.mgrid[: DEPTH_CAMERA.height, : DEPTH_CAMERA.width]
    depth = (1500 + 20 * u + 7 * v).astype(np.uint16)
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    builder.image(COLOR, START_NS, frame.color, "rgb8", COLOR_FRAME)
    builder.camera_info(DEPTH_INFO, START_NS, DEPTH_CAMERA, DEPTH_FRAME)
    builder.image(DEPTH, START_NS, depth, "16UC1", DEPTH_FRAME)
    expected = register_depth_to_color(
        depth.astype(np.float32) * 0.001, DEPTH_CAMERA, CAMERA, T_color_depth
    )
    return builder, expected


T_COLOR_DEPTH = np.array(
    [[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 1.0, -0.03], [0.0, 0.0, 0.0, 1.0]]
)


def test_depth_is_registered_through_static_transforms(tmp_path: Path) -> None:
    builder, expected = unaligned(T_COLOR_DEPTH)
    T_link_color = np.eye(4)
    T_link_color[:3, 3] = (0.0, 0.015, 0.0)
    builder.static_transform(START_NS, "camera_link", COLOR_FRAME, T_link_color)
    builder.static_transform(START_NS, "camera_link", DEPTH_FRAME, T_link_color @ T_COLOR_DEPTH)
    (frame,) = open_recording(builder.write(tmp_path)).frames()
    assert (frame.depth_m > 0).mean() > 0.3
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-6)


def test_depth_is_registered_through_realsense_extrinsics(tmp_path: Path) -> None:
    builder, expected = unaligned(T_COLOR_DEPTH)
    builder.add(
        "/camera/camera/extrinsics/depth_to_color",
        EXTRINSICS,
        START_NS,
        rotation=T_COLOR_DEPTH[:3, :3].T.flatten(),
        translation=T_COLOR_DEPTH[:3, 3].copy(),
    )
    (frame,) = open_recording(builder.write(tmp_path)).frames()
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-6)


def test_lens_distortion_is_removed(tmp_path: Path) -> None:
    """A line that the lens bends becomes straight again."""
    coefficients = (0.3, 0.0, 0.0, 0.0, 0.0)
    camera = PinholeCamera(width=64, height=64, fx=32.0, fy=32.0, cx=31.5, cy=31.5)
    v, u = np.mgrid[:64, :64].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    ideal = cv2.undistortPoints(points.reshape(-1, 1, 2), np.eye(3), np.array(coefficients))
    column = ideal.reshape(64, 64, 2)[..., 0] * camera.fx + camera.cx
    bright = ((column > 50) * 255).astype(np.uint8)
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, camera, d=coefficients)
    builder.image(COLOR, START_NS, np.dstack([bright] * 3), "rgb8")
    depth = np.where(column > 50, 1000, 2000).astype(np.uint16)
    builder.image(ALIGNED_DEPTH, START_NS, depth, "16UC1")
    (frame,) = open_recording(builder.write(tmp_path)).frames()
    rows = np.s_[12:-12]
    for edges in (
        (frame.color[rows, :, 0] > 127).argmax(axis=1),
        ((frame.depth_m[rows] > 0) & (frame.depth_m[rows] < 1.5)).argmax(axis=1),
    ):
        np.testing.assert_allclose(edges, 51, atol=1)
    assert set(np.unique(frame.depth_m)) <= {np.float32(value) for value in (0, 1, 2)}


def test_topics_can_be_named(tmp_path: Path) -> None:
    builder = BagBuilder()
    other = plane_frame(7)
    for frame in plane_frames(1):
        builder.aligned_frame(frame)
        builder.image("/other/view", frame.stamp_ns, other.color, "rgb8")
    path = builder.write(tmp_path)
    topics = RecordingTopics(color="/other/view", color_info=COLOR_INFO)
    (frame,) = open_recording(path, topics=topics).frames()
    np.testing.assert_array_equal(frame.color, other.color)
    (frame,) = open_recording(path).frames()
    np.testing.assert_array_equal(frame.color, plane_frame(0).color)


def test_given_intrinsics_replace_missing_ones(tmp_path: Path) -> None:
    builder = BagBuilder()
    for frame in plane_frames(2):
        builder.camera_info(COLOR_INFO, frame.stamp_ns, CAMERA, k=np.zeros((3, 3)))
        builder.image(COLOR, frame.stamp_ns, frame.color, "rgb8")
        builder.image(ALIGNED_DEPTH, frame.stamp_ns, depth_mm(frame), "16UC1")
    recording = open_recording(builder.write(tmp_path), camera=CAMERA)
    for actual, expected in zip(recording.frames(), plane_frames(2), strict=True):
        assert_same_frame(actual, expected)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Three times as many frames of 230 kB need no more memory."""
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
    peaks = []
    for count in (10, 30):
        folder = tmp_path / str(count)
        folder.mkdir()
        frames = [plane_frame(number, camera) for number in range(count)]
        recording = open_recording(aligned_bag(frames, folder, "db3"))
        del frames
        tracemalloc.start()
        assert sum(1 for _ in recording.frames()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
