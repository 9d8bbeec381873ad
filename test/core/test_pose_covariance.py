"""The file of covariances."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.errors import EvaluationError, OutputError
from meslam_core.pose_covariance import PoseCovariances, read_covariances, write_covariances

EPOCH_NS = 1_700_000_000_123_456_789


def some(count: int = 5) -> PoseCovariances:
    roots = np.random.default_rng(3).normal(0.0, 0.1, (count, 6, 6))
    stamps_ns = EPOCH_NS + 66_666_667 * np.arange(count)
    return PoseCovariances(stamps_ns, roots @ roots.transpose(0, 2, 1))


@pytest.mark.parametrize("count", [0, 5])
def test_file_keeps_every_nanosecond_and_the_matrices(tmp_path, count):
    written = some(count)
    write_covariances(tmp_path / "covariance.txt", written)
    read = read_covariances(tmp_path / "covariance.txt")
    assert len(read) == count
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(read.matrices, written.matrices, rtol=1e-6)
    assert [entry.name for entry in tmp_path.iterdir()] == ["covariance.txt"]


def test_the_head_names_the_columns(tmp_path):
    write_covariances(tmp_path / "covariance.txt", some(1))
    head, line = (tmp_path / "covariance.txt").read_text().splitlines()
    assert head.split()[:4] == ["#", "timestamp", "x-x", "x-y"]
    assert head.split()[-1] == "rz-rz"
    assert len(line.split()) == len(head.split()) - 1


@pytest.mark.parametrize("line", ["1.0 2.0", "1.0" + " nan" * 21, "now" + " 1.0" * 21])
def test_a_malformed_line_is_named(tmp_path, line):
    path = tmp_path / "covariance.txt"
    path.write_text(f"# comment\n{line}\n")
    with pytest.raises(EvaluationError, match=r"covariance\.txt, line 2.*timestamp x-x"):
        read_covariances(path)


def test_places_that_are_none_are_named(tmp_path):
    with pytest.raises(EvaluationError, match="missing"):
        read_covariances(tmp_path / "missing")
    with pytest.raises(OutputError, match="missing"):
        write_covariances(tmp_path / "missing" / "covariance.txt", some())
