"""Running recordings: what is written, and what happens when something is wrong."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from data.drifting_odometry import drifting
from data.memory_recording import MemoryRecording

from meslam_core.errors import EvaluationError, OutputError, RecordingError
from meslam_core.map.neural_map import NeuralMap
from meslam_core.pipeline import RunOptions, run
from meslam_core.pose_covariance import read_covariances
from meslam_core.slam import FrameResult
from meslam_core.trajectory import Trajectory, read_tum, write_tum


class Watcher:
    """Progress that keeps what it is told and may act on it."""

    def __init__(self, at: int | str = 0, action=lambda: None) -> None:
        self.told: list = []
        self._at, self._action = at, action

    def started(self, frames: int) -> None:
        self.told.append(("started", frames))

    def processed(self, offered: int, result: FrameResult) -> None:
        self.stage(offered)

    def stage(self, name: int | str) -> None:
        self.told.append(name)
        if name == self._at:
            self._action()

    def refined(self, done: int, total: int) -> None:
        assert 0 <= done < total


def covered(frame):
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def test_everything_of_the_contract_is_written(finished_run, room_frames):
    names = {file.name for file in finished_run.out.iterdir()}
    texts = {"trajectory.txt", "trajectory_online.txt", "covariance_online.txt", "frames.csv"}
    assert names == texts | {"map.meslam", "report.json"}
    stamps = [frame.stamp_ns for frame in room_frames]
    covariances = read_covariances(finished_run.out / "covariance_online.txt")
    assert covariances.stamps_ns.tolist() == stamps
    assert np.linalg.eigvalsh(covariances.matrices).min() > 0
    for name in ("trajectory.txt", "trajectory_online.txt"):
        assert read_tum(finished_run.out / name).stamps_ns.tolist() == stamps


def test_the_report_has_the_contracts_fields(finished_run, room_frames):
    report = json.loads((finished_run.out / "report.json").read_text())
    assert report == json.loads(json.dumps(finished_run.outcome.report))
    assert report["frames"] == report["frames_tracked"] == len(room_frames)
    assert report["frames_lost"] == 0
    assert report["keyframes"] >= 1
    assert report["regions"] == 1
    assert report["sensor_s"] == pytest.approx(15 * 66_666_667e-9)
    assert report["fps"] == pytest.approx(report["frames"] / report["online_s"])
    assert 0 < report["online_s"] < report["wall_s"]
    for stage in ("reading", "odometry", "tracking", "mapping"):
        assert 0 <= report["stage_ms"][stage]["median"] <= report["stage_ms"][stage]["p95"]
    files = (finished_run.out / "map.meslam").iterdir()
    assert report["map_bytes"] == sum(file.stat().st_size for file in files)
    assert 10_000 < report["map_bytes"] < 100_000
    assert 1.0 < report["observed_volume_m3"] < 12.0
    assert report["peak_rss_mb"] > 50
    for name in ("ate_rmse_m", "ate_online_rmse_m", "rpe_trans_m", "rpe_rot_deg"):
        assert name in report
    assert report["ate_rmse_m"] < 0.015
    assert report["config"]["mapping"]["first_iterations"] == 150
    assert report["camera"]["width"] == 160
    assert report["recording"] == "memory"


def test_the_stored_map_shows_the_room(finished_run, room_frames, room_poses):
    neural_map = NeuralMap.load(finished_run.out / "map.meslam")
    frame, pose = room_frames[8], room_poses[8]
    points = frame.camera.back_project(frame.depth_m)[10:110:12, 10:150:12].reshape(-1, 3)
    on_surface = points @ pose[:3, :3].T + pose[:3, 3]
    distance = neural_map.signed_distance_m(on_surface)
    assert np.mean(np.isfinite(distance)) > 0.95
    assert np.nanmedian(np.abs(distance)) < 0.015
    state, _ = neural_map.occupancy(pose[:3, 3] + 0.5 * (on_surface - pose[:3, 3]))
    assert np.mean(state == 0) > 0.95
    state, _ = neural_map.occupancy(np.array([[-20.0, 0.0, 0.0]]))
    assert state[0] == -1


def test_progress_is_told(quick_config, room_frames, tmp_path):
    watcher = Watcher()
    run(MemoryRecording(room_frames[:3]), quick_config, tmp_path, progress=watcher)
    assert watcher.told == [("started", 3), 1, 2, 3, "refining", "writing"]


def test_some_of_the_frames(quick_config, room_frames, tmp_path):
    options = RunOptions(frames=slice(1, 8, 3))
    outcome = run(MemoryRecording(room_frames), quick_config, tmp_path, options)
    assert outcome.report["frames"] == 3
    expected = [room_frames[n].stamp_ns for n in (1, 4, 7)]
    assert read_tum(tmp_path / "trajectory.txt").stamps_ns.tolist() == expected


def test_a_recording_that_breaks_off_leaves_what_came_before(quick_config, room_frames, tmp_path):
    recording = MemoryRecording(room_frames[:4], RecordingError("bag.mcap: chunk 7 is damaged"))
    outcome = run(recording, quick_config, tmp_path)
    assert "chunk 7" in outcome.broke_off
    assert outcome.report["broke_off"] == outcome.broke_off
    assert len(read_tum(tmp_path / "trajectory.txt")) == 4
    assert NeuralMap.load(tmp_path / "map.meslam").regions


def test_a_recording_that_cannot_be_read_at_all_leaves_nothing(quick_config, tmp_path):
    with pytest.raises(RecordingError, match="no frames here"):
        run(MemoryRecording([], RecordingError("no frames here")), quick_config, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("chosen", [slice(5, None), slice(40, 50)])
def test_a_choice_without_frames_is_refused(quick_config, room_frames, tmp_path, chosen):
    recording = MemoryRecording(room_frames[:3])
    with pytest.raises(RecordingError, match="none of its 3 frames"):
        run(recording, quick_config, tmp_path / "out", RunOptions(frames=chosen))
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_cannot_be_written_is_known_before_the_first_frame(
    quick_config, room_frames, tmp_path
):
    (tmp_path / "file").write_text("")
    watcher = Watcher()
    with pytest.raises(OutputError, match="cannot be written"):
        run(MemoryRecording(room_frames), quick_config, tmp_path / "file", progress=watcher)
    assert watcher.told == []


@pytest.mark.parametrize("poses", ["truth", "odometry"])
def test_poses_that_cannot_be_read_are_known_before_the_first_frame(
    quick_config, room_frames, tmp_path, poses
):
    watcher, options = Watcher(), RunOptions(**{poses: tmp_path / "none.txt"})
    with pytest.raises(EvaluationError, match=r"none\.txt"):
        run(MemoryRecording(room_frames), quick_config, tmp_path / "out", options, watcher)
    assert watcher.told == []
    assert list(tmp_path.iterdir()) == []


def test_given_poses_take_the_place_of_odometry(quick_config, room_frames, room_poses, tmp_path):
    stamps = np.array([frame.stamp_ns for frame in room_frames])
    truth = Trajectory(stamps, np.array(room_poses))
    write_tum(tmp_path / "truth.txt", truth)
    # Wheels report at other instants than the camera, and fail for a while.
    known = [number for number in range(0, 16, 2) if number != 8]
    write_tum(tmp_path / "wheels.txt", drifting(truth).subset(np.array(known)))
    options = RunOptions(truth=tmp_path / "truth.txt", odometry=tmp_path / "wheels.txt")
    results = []
    watcher = Watcher()
    watcher.processed = lambda offered, result: results.append(result)
    run(MemoryRecording(room_frames), quick_config, tmp_path / "out", options, watcher)
    without = [number for number, result in enumerate(results) if not result.odometry.valid]
    assert without == [7, 8, 9, 15]
    assert "gap of 0.267 s" in results[8].odometry.reason
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames_tracked"] == len(room_frames)
    assert report["ate_rmse_m"] < 0.015


def test_a_truth_of_another_time_does_not_cost_the_results(
    quick_config, room_frames, finished_run, tmp_path
):
    later = [replace(f, stamp_ns=f.stamp_ns + 10**12) for f in room_frames[:3]]
    options = RunOptions(truth=finished_run.truth)
    outcome = run(MemoryRecording(later), quick_config, tmp_path, options)
    assert "same clock" in outcome.not_evaluated
    assert "ate_rmse_m" not in json.loads((tmp_path / "report.json").read_text())
    assert len(read_tum(tmp_path / "trajectory.txt")) == 3


def test_lost_frames_are_counted_and_have_no_line(quick_config, room_frames, tmp_path):
    tracking = replace(quick_config.tracking, lost_after_frames=2)
    frames = [*room_frames[:3], *map(covered, room_frames[3:7])]
    outcome = run(MemoryRecording(frames), replace(quick_config, tracking=tracking), tmp_path)
    assert outcome.lost
    assert outcome.report["final_state"] == "LOST"
    assert outcome.report["frames_tracked"] == 3
    assert outcome.report["frames_lost"] == 4
    assert len(read_tum(tmp_path / "trajectory.txt")) == 3


def test_a_recording_without_any_depth_has_no_map(quick_config, room_frames, tmp_path):
    outcome = run(MemoryRecording([covered(room_frames[0])]), quick_config, tmp_path)
    assert outcome.lost
    assert outcome.report["map_bytes"] == outcome.report["regions"] == 0
    assert not (tmp_path / "map.meslam").exists()
    assert (tmp_path / "report.json").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_what_it_has(quick_config, room_frames, tmp_path, number):
    usual = signal.getsignal(number)
    watcher = Watcher(at=3, action=lambda: os.kill(os.getpid(), number))
    outcome = run(MemoryRecording(room_frames), quick_config, tmp_path, progress=watcher)
    assert outcome.interrupted
    assert outcome.report["frames"] == 3
    assert "refining" not in watcher.told
    assert len(read_tum(tmp_path / "trajectory.txt")) == 3
    assert NeuralMap.load(tmp_path / "map.meslam").regions
    assert signal.getsignal(number) is usual


def test_an_interruption_after_the_last_frame_costs_nothing(quick_config, room_frames, tmp_path):
    watcher = Watcher(at="refining", action=lambda: os.kill(os.getpid(), signal.SIGINT))
    outcome = run(MemoryRecording(room_frames[:3]), quick_config, tmp_path, progress=watcher)
    assert not outcome.interrupted
    assert len(read_tum(tmp_path / "trajectory.txt")) == 3


def test_at_the_recordings_pace_late_frames_are_skipped_and_counted(
    quick_config, room_frames, tmp_path
):
    # A million frames a second are too many for any computer. The camera rests: after skipped
    # frames no motion is possible in so short a time.
    first = room_frames[0]
    hasty = [replace(first, stamp_ns=first.stamp_ns + 1000 * n) for n in range(len(room_frames))]
    report = run(MemoryRecording(hasty), quick_config, tmp_path, RunOptions(realtime=True)).report
    assert report["frames"] + report["frames_skipped"] == len(room_frames)
    assert report["frames_skipped"] > 0
    last = read_tum(tmp_path / "trajectory.txt").stamps_ns[-1]
    assert last == hasty[-1].stamp_ns
