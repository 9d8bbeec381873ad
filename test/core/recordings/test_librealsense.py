"""Files of librealsense's recorder: two real ones of the same scene, in both of its formats."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from data.synthetic_frames import cut

from meslam_core.camera import PinholeCamera
from meslam_core.errors import RecordingError
from meslam_core.recordings import open_recording
from meslam_core.recordings.recording import Recording

DATA = os.environ.get("MESLAM_DATA", "")
FOLDER = Path(DATA) / "realsense_recordings"
BAG, DB3 = FOLDER / "d435_sdk2.55.bag", FOLDER / "d435_sdk2.59.db3"

pytestmark = pytest.mark.skipif(
    not DATA or not BAG.exists(), reason="needs the recordings in the folder MESLAM_DATA names"
)


@pytest.fixture(scope="module")
def real() -> dict[str, list[Any]]:
    pytest.importorskip("pyrealsense2")
    return {path.suffix: list(open_recording(path).frames()) for path in (BAG, DB3)}


def test_all_pairs_come_once_and_in_order(real: dict[str, list[Any]]) -> None:
    for path in (BAG, DB3):
        recording = open_recording(path)
        assert isinstance(recording, Recording)
        stamps = [frame.stamp_ns for frame in real[path.suffix]]
        assert len(recording) == len(stamps) == 30
        assert (np.diff(stamps) > 0).all()
        assert stamps == recording.stamps_ns.tolist()
        truth = np.loadtxt(FOLDER / "reference_poses.txt")[:, 0]
        np.testing.assert_allclose(np.array(stamps) * 1e-9, truth, atol=1e-5)


def test_both_formats_hold_the_same_frames(real: dict[str, list[Any]]) -> None:
    for first, second in zip(real[".bag"], real[".db3"], strict=True):
        assert first.stamp_ns == second.stamp_ns
        assert first.camera == second.camera
        np.testing.assert_array_equal(first.color, second.color)
        np.testing.assert_array_equal(first.depth_m, second.depth_m)


def test_depth_is_registered_to_colour(real: dict[str, list[Any]]) -> None:
    """librealsense's own alignment, which spreads depth by a pixel, differs at edges only."""
    rs = pytest.importorskip("pyrealsense2")
    assert open_recording(DB3).camera == PinholeCamera(640, 480, 525.0, 525.0, 320.0, 240.0)
    config = rs.config()
    config.enable_device_from_file(str(DB3), repeat_playback=False)
    config.enable_all_streams()
    pipeline = rs.pipeline()
    pipeline.start(config).get_device().as_playback().set_real_time(False)
    _, frames = pipeline.try_wait_for_frames(5000)
    aligned = rs.align(rs.stream.color).process(frames)
    stamp_ns = round(aligned.get_color_frame().get_timestamp() * 1e3) * 1000
    expected = np.asanyarray(aligned.get_depth_frame().get_data()) * np.float32(0.001)
    pipeline.stop()
    (frame,) = [frame for frame in real[".db3"] if frame.stamp_ns == stamp_ns]
    both = (expected > 0) & (frame.depth_m > 0)
    assert both.sum() > 0.97 * (expected > 0).sum()
    assert np.median(np.abs(expected - frame.depth_m)[both]) < 0.001
    assert (np.abs(expected - frame.depth_m)[both] < 0.03).mean() > 0.95


@pytest.mark.parametrize("path", [BAG, DB3], ids=["bag", "db3"])
def test_slices_and_early_end(path: Path, real: dict[str, list[Any]]) -> None:
    recording = open_recording(path)
    for wanted in ((0, 3, 1), (20, None, 4), (29, 30, 1), (40, None, 1)):
        stamps = [frame.stamp_ns for frame in recording.frames(*wanted)]
        assert stamps == [frame.stamp_ns for frame in real[path.suffix][slice(*wanted)]]
    for _ in range(3):
        frames = recording.frames()
        next(frames)
        frames.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("path", [BAG, DB3], ids=["bag", "db3"])
def test_a_program_that_stops_half_way_ends_well(path: Path) -> None:
    """Threads of librealsense must not outlive the interpreter: they would abort it."""
    program = (
        "import sys; from pathlib import Path; from meslam_core.recordings import open_recording\n"
        "frames = open_recording(Path(sys.argv[1])).frames()\n"
        "next(frames)\n"
        "raise SystemExit(7)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", program, str(path)]
    assert subprocess.run(command, env=environment, timeout=60, check=False).returncode == 7


@pytest.mark.parametrize("path", [BAG, DB3], ids=["bag", "db3"])
def test_truncated_files_are_errors(path: Path, tmp_path: Path) -> None:
    for share in (0.1, 0.9):
        copy = tmp_path / path.name
        copy.write_bytes(path.read_bytes())
        with pytest.raises(RecordingError, match=f"{path.name} cannot be read.*truncated"):
            open_recording(cut(copy, share))


def test_without_pyrealsense2_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    original = builtins.__import__

    def without(name: str, *arguments: Any, **named: Any) -> Any:
        if name == "pyrealsense2":
            raise ImportError(name)
        return original(name, *arguments, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(RecordingError, match=r"needs pyrealsense2.*meslam convert"):
        open_recording(BAG)
