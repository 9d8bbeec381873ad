"""Rigid motions: group laws, round trips, and torch against numpy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from meslam_core import se3

TURN = 0.99 * np.pi


def vectors(low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, 3, elements=st.floats(low, high))


@st.composite
def twists(draw: st.DrawFn) -> np.ndarray:
    """Any translation; rotations below half a turn, very small ones included."""
    axis = draw(vectors(-1.0, 1.0).filter(lambda v: np.linalg.norm(v) > 1e-3))
    angle = draw(st.one_of(st.floats(0.0, TURN), st.floats(0.0, 1e-4), st.just(0.0)))
    turn = angle * axis / np.linalg.norm(axis)
    return np.concatenate([draw(vectors(-10.0, 10.0)), turn])


def assert_same(first: np.ndarray, second: np.ndarray, tolerance: float = 1e-8) -> None:
    np.testing.assert_allclose(first, second, atol=tolerance, rtol=0)


@given(twists())
def test_log_undoes_exp(twist):
    assert_same(se3.log(se3.exp(twist)), twist, 1e-6)


@given(twists())
def test_exp_is_the_matrix_exponential(twist):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.hat(twist[3:]), twist[:3]
    assert_same(se3.exp(twist), expm(generator), 1e-7)


@st.composite
def rotations(draw: st.DrawFn) -> np.ndarray:
    """Any rotation matrix; those close to none and to half a turn included."""
    axis = draw(vectors(-1.0, 1.0).filter(lambda v: np.linalg.norm(v) > 1e-3))
    near = st.floats(-1e-3, 1e-3)
    angle = draw(st.one_of(st.floats(-np.pi, np.pi), near, near.map(lambda a: np.pi - a)))
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


@given(rotations())
def test_rotation_vectors_are_those_of_scipy(rotation):
    ours, theirs = se3.rotation_vector(rotation), Rotation.from_matrix(rotation).as_rotvec()
    if np.linalg.norm(theirs) > np.pi - 1e-6 and ours @ theirs < 0:
        ours = -ours  # At half a turn the axis has two directions.
    assert_same(ours, theirs)
    assert_same(Rotation.from_rotvec(ours).as_matrix(), rotation)


@given(rotations())
def test_angles_and_quaternions_are_those_of_scipy(rotation):
    pose = np.eye(4)
    pose[:3, :3] = rotation
    theirs = Rotation.from_matrix(rotation)
    assert se3.rotation_angle(pose) == pytest.approx(theirs.magnitude(), abs=1e-9)
    quaternion = se3.to_quaternion(pose)
    assert abs(quaternion @ theirs.as_quat()) == pytest.approx(1.0, abs=1e-12)


@given(twists(), twists())
def test_inverse_undoes_a_product(first, second):
    pose = se3.exp(first) @ se3.exp(second)
    assert_same(se3.inverse(pose) @ pose, np.eye(4))


@given(twists(), twists())
def test_adjoint_moves_a_twist_to_the_other_side(motion, twist):
    pose, small = se3.exp(motion), 0.1 * twist
    assert_same(pose @ se3.exp(small), se3.exp(se3.adjoint(pose) @ small) @ pose, 1e-7)


@given(twists(), hnp.arrays(np.float64, (3, 3), elements=st.floats(-1e-3, 1e-3)))
def test_orthonormalized_is_rigid_and_close(twist, noise):
    pose = se3.exp(twist)
    pose[:3, :3] += noise
    repaired = se3.orthonormalized(pose)
    assert_same(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3))
    assert np.linalg.det(repaired[:3, :3]) > 0
    assert np.abs(repaired - pose).max() < 5e-3


@given(rotations(), hnp.arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0)))
@pytest.mark.parametrize("size", [1e-9, 1e-6, 4e-6, 1e-4])
def test_orthonormalized_is_the_closest_rotation(size, rotation, noise):
    pose = np.eye(4)
    pose[:3, :3] = rotation + size * noise
    u, _, vt = np.linalg.svd(pose[:3, :3])
    assert_same(se3.orthonormalized(pose)[:3, :3], u @ vt, 1e-13)


def test_orthonormalized_makes_no_mirror_image():
    repaired = se3.orthonormalized(np.diag([1.0, 1.0, -1.0, 1.0]))
    assert np.linalg.det(repaired[:3, :3]) == pytest.approx(1.0)


@given(twists(), twists(), st.floats(0.0, 1.0))
def test_interpolation_is_a_uniform_screw_motion(first, second, fraction):
    start = se3.exp(first)
    end = start @ se3.exp(0.5 * second)
    between = se3.interpolate(start, end, fraction)
    assert_same(se3.log(se3.inverse(start) @ between), 0.5 * fraction * second, 1e-6)


@given(twists())
def test_quaternion_round_trip(twist):
    pose = se3.exp(twist)
    assert_same(se3.from_quaternion(pose[:3, 3], se3.to_quaternion(pose)), pose)


@given(twists())
def test_rotation_angle_is_the_length_of_the_rotation_vector(twist):
    assert se3.rotation_angle(se3.exp(twist)) == pytest.approx(np.linalg.norm(twist[3:]), abs=1e-7)


def test_half_a_turn_survives_the_round_trip():
    pose = se3.exp(np.array([1.0, 2.0, 3.0, 0.0, np.pi, 0.0]))
    assert_same(se3.exp(se3.log(pose)), pose)


def test_poses_need_no_torch():
    code = "import sys, meslam_core.se3; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_hat_is_the_cross_product():
    w, x = np.array([0.3, -1.0, 2.0]), np.array([1.5, 0.2, -0.7])
    assert_same(se3.hat(w) @ x, np.cross(w, x))


@given(twists())
def test_torch_exp_agrees_with_numpy(twist):
    poses = se3.torch_exp(torch.from_numpy(twist)[None])
    assert_same(poses[0].numpy(), se3.exp(twist), 1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1e-3, 0.5, 3.0])
def test_torch_exp_has_the_right_gradient(angle):
    twist = torch.tensor([[0.2, -0.4, 0.3, 0.6 * angle, 0.0, 0.8 * angle]], dtype=torch.float64)
    twist.requires_grad_(True)
    assert torch.autograd.gradcheck(se3.torch_exp, (twist,), eps=1e-7, atol=1e-5)


def test_torch_exp_takes_a_batch_in_single_precision():
    twists = torch.randn(5, 6, generator=torch.Generator().manual_seed(0))
    poses = se3.torch_exp(twists)
    assert poses.shape == (5, 4, 4)
    assert poses.dtype == torch.float32
    for twist, pose in zip(twists, poses, strict=True):
        assert_same(pose.numpy(), se3.exp(twist.numpy()), 1e-5)
