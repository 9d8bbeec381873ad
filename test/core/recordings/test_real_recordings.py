"""Real recordings of image files, their description, and their conversion."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from data.synthetic_frames import assert_same_frame

from meslam_core.recordings import McapWriter, describe, open_recording

DATA = Path(os.environ.get("MESLAM_DATA", "/nonexistent"))

pytestmark = pytest.mark.skipif(
    not DATA.exists(), reason="needs the recordings in the folder MESLAM_DATA names"
)


def recording_path(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"MESLAM_DATA has no {name}")
    return DATA / name


@pytest.mark.parametrize(
    ("name", "frames", "fx", "duration_s", "coverage"),
    [
        ("tum_fr1_xyz", 399, 517.3, 26.536, 0.75),
        ("d435_desk", 440, 615.2316, 29.267, 0.45),
        ("livingroom", 211, 525.0, 7.0, 0.98),
    ],
)
def test_descriptions(
    name: str, frames: int, fx: float, duration_s: float, coverage: float
) -> None:
    facts = describe(open_recording(recording_path(name)))
    assert json.loads(json.dumps(facts)) == facts
    assert facts["frames"] == frames
    assert facts["camera"]["fx"] == fx
    assert facts["duration_s"] == pytest.approx(duration_s, abs=0.01)
    assert facts["depth_coverage"] == pytest.approx(coverage, abs=0.02)
    near, far = facts["depth_range_m"]
    assert 0.3 < near < far < 10.0


def test_tum_survives_conversion(tmp_path: Path) -> None:
    recording = open_recording(recording_path("tum_fr1_xyz"))
    with McapWriter(tmp_path / "tum.mcap") as writer:
        for frame in recording.frames(0, 40, 10):
            writer.append(frame)
    converted = open_recording(tmp_path / "tum.mcap")
    for actual, expected in zip(converted.frames(), recording.frames(0, 40, 10), strict=True):
        assert_same_frame(actual, expected, depth_atol_m=0.00051)


def test_tum_stamps_are_exact() -> None:
    recording = open_recording(recording_path("tum_fr1_xyz"))
    first = (DATA / "tum_fr1_xyz" / "rgb.txt").read_text().splitlines()[3].split()[0]
    assert str(recording.stamps_ns[0]) == first.replace(".", "") + "000"
    assert (np.diff(recording.stamps_ns) > 0).all()
