"""The mcap writer: what other readers see, precision, and that failures leave nothing behind."""

from __future__ import annotations

import io
import os
from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from data.image_folders import write_folder
from data.synthetic_frames import CAMERA, START_NS, assert_same_frame, plane_frame, plane_frames
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from meslam_core.errors import OutputError, RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.recordings import McapWriter, convert, open_recording
from meslam_core.recordings.transforms import FrameTree
from meslam_core.recordings.writer import (
    BASE_FRAME,
    COLOR_INFO_TOPIC,
    COLOR_TOPIC,
    DEPTH_INFO_TOPIC,
    DEPTH_TOPIC,
    OPTICAL_FRAME,
)


def written(path: Path, frames: list[RgbdFrame], **options: object) -> Path:
    with McapWriter(path, **options) as writer:  # type: ignore[arg-type]
        for frame in frames:
            writer.append(frame)
    return path


def test_round_trip(tmp_path: Path) -> None:
    frames = plane_frames(7)
    recording = open_recording(written(tmp_path / "new" / "out.mcap", frames))
    for actual, expected in zip(recording.frames(), frames, strict=True):
        assert_same_frame(actual, expected)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["out.mcap"]


def test_floats_keep_every_bit_and_integers_round(tmp_path: Path) -> None:
    frame = plane_frame(0)
    frame.depth_m[5:, 5:] = np.float32(1.23456)
    frame.depth_m[3, 3] = 70.0
    (exact,) = open_recording(
        written(tmp_path / "f.mcap", [frame], depth_encoding="32FC1")
    ).frames()
    np.testing.assert_array_equal(exact.depth_m, frame.depth_m)
    (rounded,) = open_recording(written(tmp_path / "i.mcap", [frame])).frames()
    assert rounded.depth_m[6, 6] == pytest.approx(1.235)
    assert rounded.depth_m[3, 3] == 0


def test_rosbags_reads_it_as_a_rosbag2_file(tmp_path: Path) -> None:
    path = written(tmp_path / "out.mcap", plane_frames(3))
    with Reader(path) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        latched = next(c for c in reader.connections if c.topic == "/tf_static")
        assert reader.start_time == START_NS
    images = (COLOR_TOPIC, COLOR_INFO_TOPIC, DEPTH_TOPIC, DEPTH_INFO_TOPIC)
    assert counts == dict.fromkeys(images, 3) | {"/tf_static": 1}
    assert latched.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"


def test_it_reads_as_a_rosbag2_folder(tmp_path: Path) -> None:
    """ros2 bag wants a metadata.yaml in a folder; rosbag2 makes one from the file (reindex)."""
    path = written(tmp_path / "lone" / "lone.mcap", plane_frames(2))
    recording = open_recording(path.parent)
    assert_same_frame(next(recording.frames(1)), plane_frame(1))


def test_another_reader_decodes_it_with_the_embedded_definitions(tmp_path: Path) -> None:
    path = written(tmp_path / "out.mcap", plane_frames(1))
    messages = {}
    reader = mcap.reader.make_reader(
        io.BytesIO(path.read_bytes()), validate_crcs=True, decoder_factories=[DecoderFactory()]
    )
    assert reader.get_header().profile == "ros2"
    for _, channel, _, message in reader.iter_decoded_messages():
        messages[channel.topic] = message
    color, info = messages[COLOR_TOPIC], messages[COLOR_INFO_TOPIC]
    assert (color.encoding, color.width, color.height, color.step) == ("rgb8", 32, 24, 96)
    assert color.header.frame_id == messages[DEPTH_TOPIC].header.frame_id == OPTICAL_FRAME
    assert color.header.stamp.sec * 10**9 + color.header.stamp.nanosec == START_NS
    np.testing.assert_array_equal(np.reshape(info.k, (3, 3)), CAMERA.matrix)
    assert (info.distortion_model, list(info.d)) == ("plumb_bob", [0.0] * 5)
    tree = FrameTree()
    tree.add(messages["/tf_static"])
    T_base_optical = tree.lookup(BASE_FRAME, OPTICAL_FRAME)
    assert T_base_optical is not None
    forward = T_base_optical[:3, :3] @ (0, 0, 1)
    right = T_base_optical[:3, :3] @ (1, 0, 0)
    np.testing.assert_allclose(forward, (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(right, (0, -1, 0), atol=1e-12)


def test_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = written(tmp_path / "out.mcap", plane_frames(2))
    before = path.read_bytes()

    def interrupted() -> None:
        with McapWriter(path) as writer:
            writer.append(plane_frame(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["out.mcap"]


def test_conversion_of_a_damaged_recording_leaves_nothing(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(4))
    damaged = folder / "depth" / "3.png"
    damaged.write_bytes(damaged.read_bytes()[:50])
    target = tmp_path / "out" / "desk.mcap"
    with pytest.raises(RecordingError, match=r"depth/3\.png"):
        convert(open_recording(folder), target)
    assert list(target.parent.iterdir()) == []


def test_conversion_tells_its_progress(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(3))
    seen: list[tuple[int, int]] = []
    count = convert(
        open_recording(folder), tmp_path / "x.mcap", lambda done, total: seen.append((done, total))
    )
    assert count == 3
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"out\.mcap cannot be written: .*choose a folder"):
        McapWriter(tmp_path / "file" / "out.mcap")
    with pytest.raises(OutputError, match=r"not a file name that ends in \.mcap"):
        McapWriter(tmp_path / "out.bag")
    (tmp_path / "dir.mcap").mkdir()
    with pytest.raises(OutputError, match=r"not a file name that ends in \.mcap"):
        McapWriter(tmp_path / "dir.mcap")


def test_a_full_disk(tmp_path: Path) -> None:
    """/dev/full takes nothing: every write to it fails as on a full disk."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")

    def filling() -> None:
        with McapWriter(tmp_path / "out.mcap") as writer:
            with Path("/dev/full").open("wb") as full:
                os.dup2(full.fileno(), writer._stream.fileno())
            writer.append(plane_frame(0))

    with pytest.raises(OutputError, match="No space left on device"):
        filling()
    assert list(tmp_path.iterdir()) == []


def test_stamps_must_increase(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="does not follow"):
        written(tmp_path / "x.mcap", [plane_frame(1), plane_frame(1)])
    assert list(tmp_path.iterdir()) == []
