"""The facts `meslam info` shows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from data.bag_builder import COLOR, aligned_bag
from data.image_folders import write_folder
from data.synthetic_frames import CAMERA, START_NS, plane_frames

from meslam_core.recordings import describe, open_recording


def test_facts_of_a_bag(tmp_path: Path) -> None:
    path = aligned_bag(plane_frames(5), tmp_path)
    facts = describe(open_recording(path))
    assert json.loads(json.dumps(facts)) == facts
    assert facts["format"] == "rosbag2 mcap"
    assert facts["frames"] == 5
    assert facts["duration_s"] == pytest.approx(0.2)
    assert facts["rate_hz"] == pytest.approx(20.0)
    assert facts["start_s"] == START_NS / 1e9
    assert facts["bytes"] == path.stat().st_size
    assert facts["camera"] == CAMERA.to_dict()
    assert facts["topics"]["color"] == COLOR
    assert facts["depth_coverage"] == pytest.approx(1 - 4 / (32 * 24))
    assert facts["depth_range_m"] == pytest.approx([1.03, 1.39], abs=0.03)


def test_facts_of_a_folder_with_one_empty_frame(tmp_path: Path) -> None:
    (frame,) = plane_frames(1)
    frame.depth_m[:] = 0
    facts = describe(open_recording(write_folder(tmp_path / "desk", [frame])))
    assert facts["rate_hz"] is None
    assert facts["depth_coverage"] == 0
    assert facts["depth_range_m"] is None
    assert facts["topics"] == {}
