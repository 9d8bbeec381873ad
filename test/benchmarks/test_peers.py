"""The peers of the trajectory benchmark on a short walk through the textured room."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.textured_room import frame_at, path
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from peers.keyframe_graph import KeyframeGraph
from peers.peer import run_peer
from peers.pose_graph_slam import PoseGraphSlam, PoseGraphSlamConfig
from peers.reduction import reduced
from peers.rgbd_registration import Registration
from peers.tsdf_slam import TsdfSlam, TsdfSlamConfig
from slam_run import held

from meslam_core.camera import PinholeCamera
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.se3 import Pose, exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_core.trajectory import Trajectory, read_tum

CAMERA = PinholeCamera(width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
TSDF = TsdfSlamConfig(voxel_m=0.01, blocks=2000)
POSE_GRAPH = PoseGraphSlamConfig(keyframe_m=0.04)
PEERS = {"tsdf": lambda: TsdfSlam(TSDF), "pose_graph": lambda: PoseGraphSlam(POSE_GRAPH)}


@pytest.fixture(scope="module")
def walk() -> tuple[list[Pose], MemoryRecording]:
    """True poses and frames."""
    poses = path(10, step_m=0.015, step_deg=1.0)
    frames = [frame_at(pose, number, CAMERA) for number, pose in enumerate(poses)]
    return poses, MemoryRecording(frames)


@pytest.fixture(scope="module", params=PEERS)
def followed(request, walk):
    """What a peer made of the walk, and the truth."""
    poses, recording = walk
    truth = Trajectory(np.array(recording.stamps_ns), np.array(poses))
    return run_peer(PEERS[request.param](), recording, slice(None)), truth


def test_every_frame_is_tracked_to_a_centimetre(followed):
    run, truth = followed
    assert run.frames == len(run.online) == len(truth)
    assert absolute_error(run.refined, truth).rmse_m < 0.01
    assert absolute_error(run.online, truth).rmse_m < 0.01


def test_the_error_is_that_of_evo(followed):
    run, truth = followed
    reference, estimate = sync.associate_trajectories(
        as_evo(truth), as_evo(run.refined), max_diff=0.02
    )
    estimate.align(reference)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, estimate))
    assert absolute_error(run.refined, truth).rmse_m == pytest.approx(
        error.get_statistic(metrics.StatisticsType.rmse), rel=1e-6
    )


def test_results_have_the_form_of_a_run(followed, tmp_path):
    run, _ = followed
    run.write(tmp_path, dataclasses.asdict(TSDF))
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["frames_tracked"] == len(read_tum(tmp_path / "trajectory_online.txt"))
    assert report["fps"] == pytest.approx(report["frames"] / report["wall_s"])
    assert report["parameters"]["voxel_m"] == TSDF.voxel_m


@pytest.mark.parametrize("peer", PEERS)
def test_a_frame_without_depth_is_lost_and_the_next_is_not(walk, peer):
    poses, recording = walk
    frames = list(recording.frames())
    blind = dataclasses.replace(frames[2], depth_m=np.zeros_like(frames[2].depth_m))
    run = run_peer(PEERS[peer](), MemoryRecording([*frames[:2], blind, *frames[3:5]]), slice(None))
    assert blind.stamp_ns not in run.online.stamps_ns
    assert len(run.online) == 4
    motion = inverse(run.online.poses[0]) @ run.online.poses[-1]
    true_motion = inverse(poses[0]) @ poses[4]
    np.testing.assert_allclose(motion[:3, 3], true_motion[:3, 3], atol=0.01)


def test_a_lost_frame_holds_the_last_pose():
    poses = np.array(path(3))
    trajectory = Trajectory(np.array([10, 20, 40]), poses)
    filled = held(trajectory, np.array([5, 10, 20, 30, 40]))
    np.testing.assert_array_equal(filled.poses, poses[[0, 0, 1, 1, 2]])


def test_the_graph_spreads_the_error_of_a_loop_and_ignores_a_wrong_link():
    true = [exp(np.array([0.1 * n, 0.0, 0.0, 0.0, 0.0, 0.2 * n])) for n in range(6)]
    drift = exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.01]))
    graph = KeyframeGraph(link_sigma_m=0.01, robust=3.0)
    information = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    pose = true[0]
    for number in range(6):
        if number:
            step = inverse(true[number - 1]) @ true[number] @ drift
            pose = pose @ step
            graph.add_keyframe(pose)
            graph.add_link(number - 1, number, Registration(step, information, 1.0))
        else:
            graph.add_keyframe(pose)
    before = np.linalg.norm(graph.poses[5][:3, 3] - true[5][:3, 3])
    graph.add_link(0, 5, Registration(inverse(true[0]) @ true[5], information, 1.0))
    graph.add_link(1, 5, Registration(inverse(true[1]) @ true[5], information, 1.0))
    graph.add_link(0, 3, Registration(exp(np.full(6, 1.0)), information, 1.0))
    graph.optimize()
    after = np.linalg.norm(graph.poses[5][:3, 3] - true[5][:3, 3])
    assert graph.links == 8
    assert after < 0.3 * before


def test_halved_images_show_the_same_points():
    pose = T_BODY_OPTICAL
    half = reduced(frame_at(pose, 0, CAMERA), 160)
    same = frame_at(pose, 0, half.camera)
    assert half.camera.width == 160
    assert np.median(np.abs(half.depth_m - same.depth_m)) < 1e-4
    assert np.mean(np.abs(half.depth_m - same.depth_m) > 0.02) < 0.05
    assert np.mean(np.abs(half.color.astype(float) - same.color)) < 3.0


def test_halved_depth_fills_holes_and_invents_nothing():
    frame = frame_at(T_BODY_OPTICAL, 0, CAMERA)
    depth_m = np.zeros_like(frame.depth_m)
    depth_m[:2, :6] = [[1.0, 1.1, 0.0, 2.0, 0.0, 0.0], [1.2, 5.0, 1.0, 0.0, 3.0, 0.0]]
    half = reduced(dataclasses.replace(frame, depth_m=depth_m), 160)
    np.testing.assert_allclose(half.depth_m[0, :4], [1.1, 1.0, 3.0, 0.0], rtol=1e-6)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=list(trajectory.poses), timestamps=trajectory.stamps_ns * 1e-9
    )
