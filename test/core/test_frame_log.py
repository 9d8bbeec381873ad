"""The line that is written about every frame, and what reads it back."""

from __future__ import annotations

import errno
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meslam_core.errors import EvaluationError, OutputError
from meslam_core.frame_log import COLUMNS, FrameEntry, FrameLog, read_frame_log
from meslam_core.map.codec import encode
from meslam_core.map.stored_region import snapshot
from meslam_core.map_growth import MapGrowth

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "results.md"


def test_what_is_written_is_read_back(tmp_path):
    entries = [
        FrameEntry(1_600_000_000_123_456_789, "OK", tracked=True, residual_m=0.0123, regions=2),
        FrameEntry(1_600_000_000_200_000_000, "LOST", 'seen "twice", or\nnot', tracking_ms=1e9),
    ]
    with FrameLog(tmp_path / "frames.csv") as log:
        for entry in entries:
            log.add(entry)
    table = read_frame_log(tmp_path / "frames.csv")
    assert table.stamps_ns.tolist() == [entry.stamp_ns for entry in entries]
    assert table.states == ["OK", "LOST"]
    assert table.reasons == ["", entries[1].reason]
    assert table.numbers["residual_m"][0] == pytest.approx(0.0123)
    assert table.numbers["tracked"][0] == 1
    assert table.numbers["tracking_ms"][1] == 1e9
    assert np.isnan(table.numbers["map_bytes"]).all()
    assert table.known("regions")
    assert not table.known("map_bytes")


def test_lines_are_there_while_the_run_goes_on(tmp_path):
    with FrameLog(tmp_path / "frames.csv") as log:
        for number in range(1000):
            log.add(FrameEntry(number, "OK", tracking_ms=1.5))
        assert len((tmp_path / "frames.csv").read_text().splitlines()) > 500


def test_values_that_are_not_finite_are_unknown(tmp_path):
    with FrameLog(tmp_path / "frames.csv") as log:
        log.add(FrameEntry(1, "OK", residual_m=float("inf"), loss_depth=float("nan")))
    table = read_frame_log(tmp_path / "frames.csv")
    assert np.isnan([table.numbers["residual_m"][0], table.numbers["loss_depth"][0]]).all()


def test_other_columns_are_no_obstacle(tmp_path):
    (tmp_path / "frames.csv").write_text("stamp_s,state,mood,tracking_ms\n0.5,OK,good,7\n")
    table = read_frame_log(tmp_path / "frames.csv")
    assert table.stamps_ns.tolist() == [500_000_000]
    assert table.numbers["tracking_ms"].tolist() == [7.0]


@pytest.mark.parametrize(
    "text", ["stamp_s\n1\n", "stamp_s,state\nsoon,OK\n", "stamp_s,state\n1\n", "\0\n\0\n"]
)
def test_a_damaged_file_is_named(tmp_path, text):
    (tmp_path / "frames.csv").write_text(text)
    with pytest.raises(EvaluationError, match=r"frames\.csv"):
        read_frame_log(tmp_path / "frames.csv")


def test_a_full_disk_is_told():
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")

    def fill() -> None:
        with FrameLog(full) as log:
            for number in range(10_000):
                log.add(FrameEntry(number, "OK"))

    with pytest.raises(OutputError, match="/dev/full") as caught:
        fill()
    assert isinstance(caught.value.__cause__, OSError)
    assert caught.value.__cause__.errno == errno.ENOSPC


def test_a_run_records_every_frame(finished_run, room_frames):
    table = read_frame_log(finished_run.out / "frames.csv")
    report = finished_run.outcome.report
    assert table.stamps_ns.tolist() == [frame.stamp_ns for frame in room_frames]
    assert table.states == ["OK"] * len(room_frames)
    assert table.numbers["keyframe"].sum() == report["keyframes"]
    assert table.numbers["keyframes"][-1] == report["keyframes"]
    assert table.numbers["tracked"].sum() == report["frames_tracked"]
    for stage in ("reading", "odometry", "tracking", "mapping"):
        median = np.median(table.numbers[f"{stage}_ms"])
        assert median == pytest.approx(report["stage_ms"][stage]["median"], rel=1e-4)
    assert table.numbers["frame_ms"].sum() <= 1e3 * report["online_s"]
    assert np.nanmin(table.numbers["rss_mb"]) > 50
    assert np.isfinite(table.numbers["loss_distance"][1:]).all()


def test_the_maps_size_is_measured_beside_the_run(mapped_room):
    region = mapped_room.region
    slam = SimpleNamespace(working_view=region, atlas=mapped_room.atlas)
    growth = MapGrowth("int8")
    assert growth.measured_bytes(slam, 5) is None
    growth.close()
    size = len(encode(snapshot(region, 5)))
    assert growth.measured_bytes(slam, 6) == size
    slam.atlas = SimpleNamespace(regions={(0, 0, 0): region, (1, 0, 0): region})
    assert growth.measured_bytes(slam, 7) == 2 * size


def test_every_column_is_documented():
    text = DOCUMENT.read_text()
    assert len(COLUMNS) == len(fields(FrameEntry))
    assert not [name for name in COLUMNS if f"`{name}`" not in text]
