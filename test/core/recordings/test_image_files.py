"""TUM folders, and folders with color/, depth/ and camera.json."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
from data.image_folders import write_folder, write_tum
from data.synthetic_frames import CAMERA, START_NS, assert_same_frame, plane_frames

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.recordings import open_recording
from meslam_core.recordings.recording import Recording


def intrinsics(camera: PinholeCamera) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def test_tum_folder(tmp_path: Path) -> None:
    frames = plane_frames(4)
    recording = open_recording(write_tum(tmp_path / "room", frames), camera=CAMERA)
    assert isinstance(recording, Recording)
    assert len(recording) == 4
    for _ in range(2):
        for actual, expected in zip(recording.frames(), frames, strict=True):
            assert_same_frame(actual, expected)
    assert [f.stamp_ns for f in recording.frames(1, None, 2)] == [
        frames[1].stamp_ns,
        frames[3].stamp_ns,
    ]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rgbd_dataset_freiburg1_xyz", (517.3, 516.5, 318.6, 255.3)),
        ("rgbd_dataset_freiburg2_desk", (520.9, 521.0, 325.1, 249.7)),
        ("tum_fr3_office", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_tum_intrinsics_follow_the_freiburg_number(
    tmp_path: Path, name: str, expected: tuple[float, ...]
) -> None:
    recording = open_recording(write_tum(tmp_path / name, plane_frames(1)))
    assert intrinsics(recording.camera) == expected


def test_tum_intrinsics_by_default_come_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        recording = open_recording(write_tum(tmp_path / "mine", plane_frames(1)))
    assert intrinsics(recording.camera) == (525.0, 525.0, 319.5, 239.5)
    assert "default intrinsics" in caplog.text


def test_tum_camera_json_wins_over_the_name(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1_xyz", plane_frames(2))
    description = CAMERA.to_dict() | {"depth_scale_m": 0.0004}
    (folder / "camera.json").write_text(json.dumps(description))
    (first, _) = open_recording(folder).frames()
    assert first.camera == CAMERA
    assert first.depth_m.max() == pytest.approx(2 * plane_frames(1)[0].depth_m.max())


def test_tum_images_without_a_partner_are_skipped(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "room", plane_frames(4))
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    stamps = [frame.stamp_ns for frame in open_recording(folder, camera=CAMERA).frames()]
    assert stamps == [frame.stamp_ns for i, frame in enumerate(plane_frames(4)) if i != 1]


def test_folder_in_natural_order(tmp_path: Path) -> None:
    frames = plane_frames(12)
    recording = open_recording(write_folder(tmp_path / "desk", frames))
    assert isinstance(recording, Recording)
    for actual, expected in zip(recording.frames(), frames, strict=True):
        assert_same_frame(actual, expected)


def test_folder_without_timestamps_runs_at_its_rate(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(4), stamps=False, fps=30)
    stamps = [frame.stamp_ns for frame in open_recording(folder).frames()]
    assert stamps == [0, 33_333_333, 66_666_667, 100_000_000]


def test_folder_frames_out_of_order_are_sorted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(4))
    stamps = (folder / "timestamps.txt").read_text().split()
    swapped = [stamps[1], stamps[0], stamps[3], stamps[3]]
    (folder / "timestamps.txt").write_text("\n".join(swapped))
    with caplog.at_level(logging.WARNING):
        frames = list(open_recording(folder).frames())
    assert [frame.stamp_ns - START_NS for frame in frames] == [0, 50_000_000, 150_000_000]
    assert (frames[0].color == plane_frames(2)[1].color).all()
    assert "repeated stamp" in caplog.text


def test_folder_depth_scale_and_given_camera(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(1), depth_scale_m=0.002)
    other = PinholeCamera(32, 24, 99.0, 99.0, 16.0, 12.0)
    (frame,) = open_recording(folder, camera=other).frames()
    assert frame.camera == other
    assert frame.depth_m.max() == pytest.approx(2 * plane_frames(1)[0].depth_m.max())
    (folder / "camera.json").unlink()
    (frame,) = open_recording(folder, camera=other).frames()
    assert frame.depth_m.max() == pytest.approx(plane_frames(1)[0].depth_m.max())


def test_a_damaged_image_is_named_after_the_good_frames(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(3))
    damaged = folder / "color" / "2.png"
    damaged.write_bytes(damaged.read_bytes()[:100])
    recording = open_recording(folder)
    frames = recording.frames()
    assert next(frames).stamp_ns == START_NS
    next(frames)
    with pytest.raises(RecordingError, match=r"color/2\.png.*damaged"):
        next(frames)
    (folder / "depth" / "0.png").unlink()
    with pytest.raises(RecordingError, match=r"depth/0\.png cannot be read: No such file"):
        list(recording.frames())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "depth" / "1.png").unlink(), "3 images in color/ and 2 in depth/"),
        (lambda f: (f / "timestamps.txt").write_text("1\n2\n"), "2 stamps for 3 pairs"),
        (lambda f: (f / "timestamps.txt").write_text("1\nx\n3"), "'x' is not a number of seconds"),
        (lambda f: (f / "camera.json").unlink(), "camera.json is not a camera description"),
        (lambda f: (f / "camera.json").write_text("{"), "camera.json is not a camera description"),
    ],
)
def test_folders_that_do_not_fit(tmp_path: Path, change: object, message: str) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(3))
    change(folder)  # type: ignore[operator]
    with pytest.raises(RecordingError, match=message):
        open_recording(folder)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"fps": 0}, "fps is 0, expected a positive number"),
        ({"depth_scale_m": "mm"}, "depth_scale_m is 'mm'"),
        ({"fps": None}, "tells no time: add `fps`"),
        ({"depth_aligned_to_color": False}, "not aligned to colour"),
    ],
)
def test_descriptions_that_do_not_serve(
    tmp_path: Path, description: dict[str, object], message: str
) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(2), stamps=False, **description)
    with pytest.raises(RecordingError, match=message):
        open_recording(folder)


def test_images_of_another_size_than_the_camera(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "desk", plane_frames(1), width=640, height=480)
    with pytest.raises(RecordingError, match=r"color/0\.png.*\(24, 32, 3\), expected.*480, 640"):
        list(open_recording(folder).frames())


def test_a_list_that_is_not_one(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", plane_frames(1))
    (folder / "rgb.txt").write_text("# colour\n12.5\n")
    with pytest.raises(RecordingError, match=r"rgb\.txt, line 2: expected `seconds file`"):
        open_recording(folder)


def test_no_images_at_all(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", plane_frames(1))
    (folder / "rgb.txt").write_text("# colour\n")
    with pytest.raises(RecordingError, match="no colour images"):
        open_recording(folder)
    (tmp_path / "empty" / "color").mkdir(parents=True)
    (tmp_path / "empty" / "depth").mkdir()
    with pytest.raises(RecordingError, match="no images in color/ and depth/"):
        open_recording(tmp_path / "empty", camera=CAMERA)
