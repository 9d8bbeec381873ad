"""Bags that cannot be used: each error names the thing and the remedy."""

from __future__ import annotations

import logging
import os
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from data.bag_builder import (
    ALIGNED_DEPTH,
    ALIGNED_DEPTH_INFO,
    COLOR,
    COLOR_INFO,
    DEPTH,
    DEPTH_FRAME,
    DEPTH_INFO,
    BagBuilder,
    Storage,
    aligned_bag,
)
from data.synthetic_frames import (
    CAMERA,
    START_NS,
    assert_same_frame,
    cut,
    depth_mm,
    plane_frame,
    plane_frames,
)

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.recordings import McapWriter, RecordingTopics, open_recording


def image_pair(builder: BagBuilder, depth_topic: str = ALIGNED_DEPTH, frame_id: str = "a") -> None:
    frame = plane_frame(0)
    builder.image(COLOR, frame.stamp_ns, frame.color, "rgb8", "a")
    builder.image(depth_topic, frame.stamp_ns, depth_mm(frame), "16UC1", frame_id)


def test_names_that_are_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    for place in (tmp_path / "pipe.mcap", Path("/dev/zero")):
        with pytest.raises(RecordingError, match="no file and no folder"):
            open_recording(place)
    with pytest.raises(RecordingError, match="too long"):
        open_recording(tmp_path / ("long" * 100))


def test_missing_file_and_unknown_things(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nothing\.mcap does not exist; expected a rosbag2"):
        open_recording(tmp_path / "nothing.mcap")
    with pytest.raises(RecordingError, match="is not a recording; expected a rosbag2"):
        open_recording(tmp_path)
    for name, content, message in (
        ("x.mcap", b"", "is empty"),
        ("x.mcap", b"hello, world. no recording", "is not a recording, or its beginning is"),
        ("x.bag", b"SQLite format 3\0" + bytes(100), r"is a \.db3 file by its content; rename"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            open_recording(tmp_path / name)


@pytest.mark.parametrize("storage", ["db3", "bag"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_truncated_files_are_errors(tmp_path: Path, storage: str, share: float) -> None:
    path = cut(aligned_bag(plane_frames(20), tmp_path, storage), share)  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=f"{path.name} cannot be read.*truncated"):
        open_recording(path)


def test_truncated_mcap_is_recovered_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
    generator = np.random.default_rng(0)
    path = tmp_path / "long.mcap"
    with McapWriter(path) as writer:
        for number in range(60):
            frame = plane_frame(number, camera)
            frame.color[:] = generator.integers(0, 256, frame.color.shape)
            writer.append(frame)
    whole = list(open_recording(path).frames())
    with caplog.at_level(logging.WARNING):
        recording = open_recording(cut(path, 0.7))
    assert "long.mcap is truncated; recovered" in caplog.text
    frames = list(recording.frames())
    assert 20 < len(recording) == len(frames) < 60
    for actual, expected in zip(frames, whole, strict=False):
        assert_same_frame(actual, expected)
    assert [f.stamp_ns for f in recording.frames(5, 12, 3)] == [f.stamp_ns for f in whole[5:12:3]]


def test_folder_of_a_killed_recorder_is_recovered(tmp_path: Path) -> None:
    """`ros2 bag record` that is killed leaves no metadata.yaml and no end of the file."""
    folder = aligned_bag(plane_frames(400), tmp_path, "folder")
    cut(folder / "recording.mcap", 0.9)
    (folder / "metadata.yaml").unlink()
    recording = open_recording(folder)
    assert 100 < len(recording) < 400
    assert_same_frame(next(recording.frames()), plane_frame(0))


def test_mcap_without_one_whole_chunk(tmp_path: Path) -> None:
    path = cut(aligned_bag(plane_frames(5), tmp_path), 0.3)
    with pytest.raises(RecordingError, match="truncated and holds no complete message"):
        open_recording(path)


def test_damage_in_the_middle_yields_what_comes_before(tmp_path: Path) -> None:
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
    path = tmp_path / "damaged.mcap"
    generator = np.random.default_rng(0)
    with McapWriter(path) as writer:
        for number in range(60):
            frame = plane_frame(number, camera)
            frame.color[:] = generator.integers(0, 256, frame.color.shape)
            writer.append(frame)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 1000] = bytes(1000)
    path.write_bytes(data)
    recording = open_recording(path)
    frames = recording.frames()
    assert 10 < len(list(islice(frames, len(recording)))) < 60
    with pytest.raises(RecordingError, match=rf"damaged\.mcap is damaged.*{len(recording)} frames"):
        next(frames)
    assert len(list(recording.frames(0, 5))) == 5


def test_a_topic_that_is_not_there(tmp_path: Path) -> None:
    path = aligned_bag(plane_frames(1), tmp_path)
    with pytest.raises(RecordingError, match=r"no images on the colour topic /nowhere.*" + COLOR):
        open_recording(path, topics=RecordingTopics(color="/nowhere"))
    with pytest.raises(RecordingError, match="no images on the depth topic /nowhere"):
        open_recording(path, topics=RecordingTopics(depth="/nowhere"))
    with pytest.raises(RecordingError, match=rf"no camera info on .*/no_info.*{COLOR_INFO}"):
        open_recording(path, topics=RecordingTopics(color_info="/no_info"))
    with pytest.raises(RecordingError, match="cannot be both"):
        open_recording(path, topics=RecordingTopics(depth=COLOR))


def test_no_depth_and_no_images(tmp_path: Path) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    (tmp_path / "a").mkdir()
    with pytest.raises(RecordingError, match="no colour images; its image topics are: none"):
        open_recording(builder.write(tmp_path / "a"))
    builder.image(COLOR, START_NS, plane_frame(0).color, "rgb8")
    (tmp_path / "b").mkdir()
    with pytest.raises(RecordingError, match=rf"no depth images.*{COLOR} \(rgb8\)"):
        open_recording(builder.write(tmp_path / "b"))


def test_images_that_never_meet(tmp_path: Path) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    frame = plane_frame(0)
    builder.image(COLOR, START_NS, frame.color, "rgb8")
    builder.image(ALIGNED_DEPTH, START_NS + 10**9, depth_mm(frame), "16UC1")
    with pytest.raises(RecordingError, match="none lie within 20 ms"):
        len(open_recording(builder.write(tmp_path)))


def test_several_topics_that_fit(tmp_path: Path) -> None:
    builder = BagBuilder()
    frame = plane_frame(0)
    for name in ("left", "right"):
        builder.image(f"/{name}/image", START_NS, frame.color, "rgb8")
    builder.image("/depth", START_NS, depth_mm(frame), "16UC1")
    with pytest.raises(RecordingError, match="several colour topics: /left/image, /right/image"):
        open_recording(builder.write(tmp_path), camera=CAMERA)


def test_wrong_encoding(tmp_path: Path) -> None:
    builder = BagBuilder()
    frame = plane_frame(0)
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    builder.image(COLOR, START_NS, frame.color[..., 0], "bayer_rggb8")
    builder.image(ALIGNED_DEPTH, START_NS, depth_mm(frame), "16UC1")
    path = builder.write(tmp_path)
    with pytest.raises(RecordingError, match=rf"no colour images.*{COLOR} \(bayer_rggb8\)"):
        open_recording(path)
    recording = open_recording(path, topics=RecordingTopics(color=COLOR))
    with pytest.raises(RecordingError, match=r"frame 0.*encoding 'bayer_rggb8'; expected one of"):
        list(recording.frames())


@pytest.mark.parametrize("storage", ["mcap", "bag"])
def test_a_camera_info_that_changes_is_told_once(
    tmp_path: Path, storage: Storage, caplog: pytest.LogCaptureFixture
) -> None:
    frames = plane_frames(6)
    for number in (3, 4):
        camera = replace(frames[number].camera, fx=45.0)
        frames[number] = replace(frames[number], camera=camera)
    recording = open_recording(aligned_bag(frames, tmp_path, storage))
    assert len(list(recording.frames())) == 6
    recording.close()
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 2
    for topic in (COLOR_INFO, ALIGNED_DEPTH_INFO):
        assert sum(f"{topic} changes at" in each for each in told) == 1
    assert all("fx 30.0 to 45.0" in each for each in told)


def test_camera_info_missing_or_without_intrinsics(tmp_path: Path) -> None:
    builder = BagBuilder()
    image_pair(builder)
    (tmp_path / "a").mkdir()
    with pytest.raises(RecordingError, match=r"no camera info.*--camera camera\.json"):
        open_recording(builder.write(tmp_path / "a"))
    builder.camera_info(COLOR_INFO, START_NS, CAMERA, k=np.zeros((3, 3)))
    (tmp_path / "b").mkdir()
    with pytest.raises(RecordingError, match=rf"{COLOR_INFO} has no intrinsics.*--camera"):
        open_recording(builder.write(tmp_path / "b"))


def test_depth_of_another_size_without_its_camera_info(tmp_path: Path) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    builder.image(COLOR, START_NS, plane_frame(0).color, "rgb8")
    builder.image(DEPTH, START_NS, np.ones((10, 12), np.uint16), "16UC1")
    with pytest.raises(RecordingError, match=r"12x10, colour is 32x24.*record the depth camera"):
        open_recording(builder.write(tmp_path))


def test_depth_in_another_frame_without_transforms(tmp_path: Path) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, CAMERA)
    builder.camera_info(DEPTH_INFO, START_NS, CAMERA)
    image_pair(builder, DEPTH, DEPTH_FRAME)
    builder.static_transform(START_NS, "somewhere", "else", np.eye(4))
    with pytest.raises(RecordingError, match=f"{DEPTH_FRAME}.*no transform.*align_depth"):
        open_recording(builder.write(tmp_path))


def test_colour_of_another_size_than_its_camera_info(tmp_path: Path) -> None:
    builder = BagBuilder()
    builder.camera_info(COLOR_INFO, START_NS, PinholeCamera(640, 480, 525.0, 525.0, 320.0, 240.0))
    frame = plane_frame(0)
    builder.image(COLOR, START_NS, frame.color, "rgb8")
    builder.image(ALIGNED_DEPTH, START_NS, np.ones((480, 640), np.uint16), "16UC1")
    recording = open_recording(builder.write(tmp_path))
    with pytest.raises(RecordingError, match=r"frame 0.*\(24, 32, 3\), expected"):
        list(recording.frames())


def test_a_file_missing_from_a_bag_folder(tmp_path: Path) -> None:
    folder = aligned_bag(plane_frames(1), tmp_path, "folder")
    shutil.move(folder / "recording.mcap", tmp_path)
    with pytest.raises(RecordingError, match="files are missing"):
        open_recording(folder)


def test_a_bag_without_messages(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no colour images; its image topics are: none"):
        open_recording(BagBuilder().write(tmp_path))
