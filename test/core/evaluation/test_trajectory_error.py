"""Trajectory errors: known answers, and agreement with evo."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meslam_core import se3
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.alignment import associate, rigid_alignment
from meslam_core.evaluation.report import trajectory_entries, truth_entries
from meslam_core.evaluation.trajectory_error import (
    absolute_error,
    frame_jitter_m,
    relative_error_by_frames,
    relative_error_by_time,
)
from meslam_core.trajectory import Trajectory, read_tum

INTERVAL_NS = 66_666_667


def waving_path(count: int = 120) -> Trajectory:
    """A smooth path that turns about every axis."""
    t = np.arange(count) / 15.0
    angles = np.stack([0.5 * np.sin(t), 0.4 * np.sin(1.3 * t + 1), 0.3 * np.cos(0.7 * t)], 1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    poses[:, :3, 3] = np.stack([np.cos(0.8 * t), 0.6 * np.sin(t), 0.2 * np.sin(2.1 * t)], 1)
    return Trajectory(10**18 + INTERVAL_NS * np.arange(count), poses)


def noisy(trajectory: Trajectory, translation_m: float, rotation_rad: float) -> Trajectory:
    rng = np.random.default_rng(3)
    scale = np.repeat([translation_m, rotation_rad], 3)
    twists = rng.normal(size=(len(trajectory), 6)) * scale
    return Trajectory(
        trajectory.stamps_ns,
        np.stack([pose @ se3.exp(t) for pose, t in zip(trajectory.poses, twists, strict=True)]),
    )


SOME_POSE = se3.exp(np.array([0.8, -1.2, 0.3, 0.4, -0.9, 1.7]))


def test_perfect_trajectory_in_another_frame_has_no_error():
    truth = waving_path()
    estimate = truth.transformed(SOME_POSE)
    result = absolute_error(estimate, truth)
    assert result.rmse_m < 1e-12
    np.testing.assert_allclose(result.mounting.T_truth_map, se3.inverse(SOME_POSE), atol=1e-12)
    relative = relative_error_by_frames(estimate, truth)
    assert relative.trans_rmse_m < 1e-12
    assert relative.rot_rmse_deg < 1e-5


def test_known_shift_of_half_the_path():
    """Half the poses moved by 2d along z: after alignment of a flat path nothing is left but d."""
    count = 400
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :2, 3] = np.repeat(rng.normal(size=(count // 2, 2)), 2, axis=0)
    truth = Trajectory(INTERVAL_NS * np.arange(count), poses)
    shifted = poses.copy()
    shifted[1::2, 2, 3] += 0.06
    result = absolute_error(Trajectory(truth.stamps_ns, shifted), truth)
    assert result.rmse_m == pytest.approx(0.03, abs=1e-9)
    assert result.median_m == pytest.approx(0.03, abs=1e-9)
    assert result.max_m == pytest.approx(0.03, abs=1e-9)


def test_alignment_is_a_rotation_even_for_mirrored_points():
    points = np.random.default_rng(1).normal(size=(50, 3))
    alignment = rigid_alignment(points, points * [1, 1, -1])
    assert np.linalg.det(alignment[:3, :3]) == pytest.approx(1.0)


def test_relative_error_of_a_known_drift_a_frame():
    """Every step turns 1 deg too far about z and goes 2 mm too far."""
    truth = waving_path()
    extra = se3.exp(np.array([0.0, 0.0, 0.002, 0.0, 0.0, np.radians(1.0)]))
    poses = [truth.poses[0]]
    for before, after in zip(truth.poses[:-1], truth.poses[1:], strict=True):
        poses.append(poses[-1] @ se3.inverse(before) @ after @ extra)
    relative = relative_error_by_frames(Trajectory(truth.stamps_ns, np.stack(poses)), truth)
    np.testing.assert_allclose(relative.translations_m, 0.002, atol=1e-9)
    np.testing.assert_allclose(relative.rotations_deg, 1.0, atol=1e-9)


def test_relative_error_over_a_second_pairs_frames_a_second_apart():
    truth = waving_path()
    by_time = relative_error_by_time(noisy(truth, 0.01, 0.01), truth, 1.0)
    by_frames = relative_error_by_frames(noisy(truth, 0.01, 0.01), truth, 15)
    np.testing.assert_allclose(by_time.translations_m, by_frames.translations_m)
    with pytest.raises(EvaluationError, match="hold no step of 60 s"):
        relative_error_by_time(truth, truth, 60.0)


def test_jitter_ignores_gaps():
    truth = waving_path()
    estimate = truth.poses.copy()
    estimate[60:] = SOME_POSE @ estimate[60:]
    kept = np.r_[0:60, 70:120]
    gap = Trajectory(truth.stamps_ns, estimate).subset(kept)
    assert frame_jitter_m(gap, truth) < 1e-9
    assert frame_jitter_m(Trajectory(truth.stamps_ns, estimate), truth) > 0.05


def test_association_uses_every_pose_once_and_the_nearest():
    truth = waving_path(30)
    stamps = truth.stamps_ns[5:20] + 3_000_000
    crowded = np.sort(np.concatenate([stamps, stamps[:3] + 9_000_000]))
    estimate = Trajectory(crowded, np.tile(np.eye(4), (len(crowded), 1, 1)))
    paired, paired_truth = associate(estimate, truth)
    np.testing.assert_array_equal(paired.stamps_ns, stamps)
    np.testing.assert_array_equal(paired_truth.stamps_ns, truth.stamps_ns[5:20])


def test_trajectories_on_other_clocks_are_refused():
    truth = waving_path()
    other = Trajectory(truth.stamps_ns - 10**18, truth.poses)
    with pytest.raises(EvaluationError, match=r"only 0 poses.*same clock"):
        absolute_error(other, truth)


def test_lever_arm_of_another_sensor_is_recovered():
    estimate = waving_path()
    T_camera_sensor = se3.exp(np.array([0.09, -0.03, 0.02, 0.2, 2.8, -0.4]))
    truth = estimate.transformed(SOME_POSE, T_camera_sensor)
    result = absolute_error(estimate, truth, hand_eye=True)
    assert result.rmse_m < 1e-6
    np.testing.assert_allclose(result.mounting.T_camera_sensor, T_camera_sensor, atol=1e-6)
    np.testing.assert_allclose(result.mounting.T_truth_map, SOME_POSE, atol=1e-6)


def test_lever_arm_is_recovered_from_noisy_poses():
    estimate = noisy(waving_path(), 0.005, 0.005)
    T_camera_sensor = se3.exp(np.array([0.09, -0.03, 0.02, 0.1, 0.3, -0.4]))
    truth = waving_path().transformed(SOME_POSE, T_camera_sensor)
    result = absolute_error(estimate, truth, hand_eye=True)
    assert result.rmse_m < 0.010
    assert absolute_error(estimate, truth).rmse_m > 2 * result.rmse_m
    np.testing.assert_allclose(
        result.mounting.T_camera_sensor[:3, 3], T_camera_sensor[:3, 3], atol=0.01
    )


def test_lever_arm_needs_rotation():
    straight = waving_path()
    poses = straight.poses.copy()
    poses[:, :3, :3] = np.eye(3)
    straight = Trajectory(straight.stamps_ns, poses)
    with pytest.raises(EvaluationError, match="hardly turns"):
        absolute_error(straight, straight, hand_eye=True)


def evo_trajectory(trajectory: Trajectory):
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        poses_se3=list(trajectory.poses), timestamps=trajectory.stamps_ns * 1e-9
    )


def assert_agrees_with_evo(estimate: Trajectory, truth: Trajectory) -> None:
    pytest.importorskip("evo")
    from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit

    paired, paired_truth = associate(estimate, truth)
    evo_estimate, evo_truth = evo_trajectory(paired), evo_trajectory(paired_truth)
    for relation, name in (
        (PoseRelation.translation_part, "trans_rmse_m"),
        (PoseRelation.rotation_angle_deg, "rot_rmse_deg"),
    ):
        rpe = RPE(relation, delta=1, delta_unit=Unit.frames)
        rpe.process_data((evo_truth, evo_estimate))
        ours = getattr(relative_error_by_frames(estimate, truth), name)
        assert ours == pytest.approx(rpe.get_statistic(StatisticsType.rmse), abs=1e-6)
    evo_estimate.align(evo_truth)
    ape = APE(PoseRelation.translation_part)
    ape.process_data((evo_truth, evo_estimate))
    ours = absolute_error(estimate, truth)
    assert ours.rmse_m == pytest.approx(ape.get_statistic(StatisticsType.rmse), abs=1e-6)
    assert ours.median_m == pytest.approx(ape.get_statistic(StatisticsType.median), abs=1e-6)
    np.testing.assert_allclose(ours.errors_m, ape.error, atol=1e-6)


def test_errors_agree_with_evo():
    truth = waving_path()
    assert_agrees_with_evo(noisy(truth.transformed(SOME_POSE), 0.02, 0.02), truth)


def test_errors_agree_with_evo_on_a_recorded_truth():
    data = os.environ.get("MESLAM_DATA")
    if not data or not (Path(data) / "tum_fr1_xyz/groundtruth.txt").exists():
        pytest.skip("MESLAM_DATA names no folder with tum_fr1_xyz")
    truth = read_tum(Path(data) / "tum_fr1_xyz/groundtruth.txt")
    estimate = truth.subset(np.arange(0, len(truth), 7))
    moved = Trajectory(estimate.stamps_ns + 2_000_000, estimate.poses)
    assert_agrees_with_evo(noisy(moved, 0.01, 0.01), truth)


def test_report_entries_carry_the_contract_names():
    truth = waving_path()
    refined, online = noisy(truth, 0.001, 0.001), noisy(truth, 0.02, 0.01)
    entries = truth_entries(refined, online, truth)
    assert {"ate_rmse_m", "ate_online_rmse_m", "rpe_trans_m", "rpe_rot_deg"} <= set(entries)
    assert entries["ate_rmse_m"] < 0.003
    assert 0.02 < entries["ate_online_rmse_m"] < 0.05
    assert entries["jitter_online_m"] > 0.02
    expected = relative_error_by_time(refined, truth).trans_rmse_m
    assert entries["rpe_trans_m"] == pytest.approx(expected)


def test_report_of_a_short_trajectory_has_no_error_a_second():
    entries = trajectory_entries(waving_path(10), waving_path(10))
    assert entries["rpe_trans_m"] is None
    assert entries["ate_rmse_m"] < 1e-9
