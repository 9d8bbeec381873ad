"""Pictures are written, readable, and show what they should."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from meslam_core.errors import OutputError
from meslam_core.evaluation.plots import (
    ViewPair,
    plot_error_over_time,
    plot_path,
    plot_path_alone,
    plot_views,
)
from meslam_core.evaluation.trajectory_error import AbsoluteError, absolute_error
from meslam_core.trajectory import Trajectory


def circle() -> Trajectory:
    angle = np.linspace(0, 6, 60)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.cos(angle), np.sin(angle)
    return Trajectory(66_666_667 * np.arange(60), poses)


def error() -> AbsoluteError:
    truth = circle()
    shaken = truth.poses.copy()
    shaken[:, :3, 3] += np.random.default_rng(0).normal(0, 0.01, (60, 3))
    return absolute_error(Trajectory(truth.stamps_ns, shaken), truth)


def view_pair(label: str) -> ViewPair:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (48, 64, 3), np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    return ViewPair(label, image, image[::-1].copy(), depth, depth + np.float32(0.03))


@pytest.mark.parametrize(
    "draw",
    [
        lambda path: plot_path(path, error(), "circle"),
        lambda path: plot_path_alone(path, circle(), "circle"),
        lambda path: plot_error_over_time(path, {"refined": error(), "online": error()}, "circle"),
        lambda path: plot_views(path, [view_pair("1 s"), view_pair("2 s")], "circle"),
    ],
)
def test_picture_is_written_whole(tmp_path, draw):
    draw(tmp_path / "picture.png")
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]
    picture = cv2.imread(str(tmp_path / "picture.png"))
    assert min(picture.shape[:2]) > 300
    assert picture.std() > 10


def test_path_is_seen_along_the_vertical(tmp_path):
    """The circle lies in x and z, across the image's y: from above it is round, not a line."""
    plot_path_alone(tmp_path / "picture.png", circle(), "circle")
    picture = cv2.imread(str(tmp_path / "picture.png")).astype(int)
    blue = (picture[:, :, 0] - picture[:, :, 2]) > 80
    rows, columns = np.nonzero(blue)
    assert np.ptp(rows) > 0.7 * np.ptp(columns)


def test_views_without_common_depth_are_drawn_all_the_same(tmp_path):
    pair = view_pair("nothing")
    empty = ViewPair("nothing", pair.image, pair.rendered, pair.depth_m, 0 * pair.depth_m)
    plot_views(tmp_path / "picture.png", [empty], "empty")
    assert (tmp_path / "picture.png").exists()


def test_unwritable_place_is_named(tmp_path):
    with pytest.raises(OutputError, match=r"missing/picture\.png.*writable"):
        plot_path_alone(tmp_path / "missing" / "picture.png", circle(), "circle")
