"""Trajectories and their TUM text form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meslam_core.errors import EvaluationError, OutputError
from meslam_core.trajectory import Trajectory, read_tum, write_tum

EPOCH_NS = 1_700_000_000_123_456_789


def random_trajectory(count: int = 20) -> Trajectory:
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return Trajectory(EPOCH_NS + 66_666_667 * np.arange(count), poses)


def test_file_keeps_every_nanosecond_and_the_poses(tmp_path):
    written = random_trajectory()
    write_tum(tmp_path / "trajectory.txt", written)
    read = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(read.poses, written.poses, atol=1e-8)


def test_line_has_the_tum_columns(tmp_path):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose[:3, 3] = [1.0, -2.0, 0.5]
    write_tum(tmp_path / "one.txt", Trajectory(np.array([1_500_000_000]), pose[None]))
    lines = (tmp_path / "one.txt").read_text().splitlines()
    assert lines[0] == "# timestamp tx ty tz qx qy qz qw"
    assert lines[1].split()[0] == "1.500000000"
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        [float(x) for x in lines[1].split()[1:]], [1, -2, 0.5, 0, 0, half, half], atol=1e-9
    )


def test_writing_replaces_and_leaves_nothing_else(tmp_path):
    target = tmp_path / "trajectory.txt"
    target.write_text("old")
    write_tum(target, random_trajectory())
    assert [entry.name for entry in tmp_path.iterdir()] == ["trajectory.txt"]
    assert len(read_tum(target)) == 20


def test_unwritable_place_is_named(tmp_path):
    target = tmp_path / "missing" / "trajectory.txt"
    with pytest.raises(OutputError, match=r"missing/trajectory\.txt.*choose a folder"):
        write_tum(target, random_trajectory())


def test_length_and_duration_of_a_straight_path():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = 0.25 * np.arange(5)
    trajectory = Trajectory(500_000_000 * np.arange(5), poses)
    assert trajectory.length_m == pytest.approx(1.0)
    assert trajectory.duration_s == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        ("0.0 1 2 3\n", "line 1: 4 values"),
        ("0.0 1 2 x 0 0 0 1\n", "line 1: not a number"),
        ("# head\n0.0 1 2 nan 0 0 0 1\n", "line 2: a value is not finite"),
        ("0.0 1 2 3 0 0 0 0\n", "quaternion has norm 0"),
        ("1.0 1 2 3 0 0 0 1\n1.0 1 2 3 0 0 0 1\n", "does not follow"),
        ("2.0 1 2 3 0 0 0 1\n1.0 1 2 3 0 0 0 1\n", "does not follow"),
    ],
)
def test_malformed_file_is_refused_with_its_line(tmp_path, content, message):
    path = tmp_path / "poses.txt"
    path.write_text(content)
    with pytest.raises(EvaluationError, match=message) as caught:
        read_tum(path)
    assert str(path) in str(caught.value)


def test_missing_and_binary_files_are_refused(tmp_path):
    (tmp_path / "image.txt").write_bytes(b"\xff\xfe\x00\x81")
    for name in ("missing.txt", "image.txt"):
        with pytest.raises(EvaluationError, match=f"{name}.*cannot be read"):
            read_tum(tmp_path / name)


def test_poses_that_are_not_rigid_are_refused():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 0] = 1.1
    with pytest.raises(EvaluationError, match=r"pose 1 at 0\.000000001 s"):
        Trajectory(np.array([0, 1]), poses)
    with pytest.raises(EvaluationError, match="expected"):
        Trajectory(np.array([0]), poses)
