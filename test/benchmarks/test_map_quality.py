"""The benchmark of map quality: what it asks for, how it scores, both mappers on exact views."""

from __future__ import annotations

from types import SimpleNamespace

import map_quality
import numpy as np
import pytest
from data.textured_room import frame_at, path
from map_quality import Answers, Attempt, Scene, View

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig, SensorConfig
from meslam_core.field.rendering import surface_level
from meslam_core.frame import RgbdFrame
from meslam_core.trajectory import Trajectory

CAMERA = PinholeCamera(width=160, height=120, fx=130.0, fy=131.0, cx=79.0, cy=60.5)
SENSOR = SensorConfig()
MILLISECOND_NS = 1_000_000


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Four keyframes of the textured room and two views between them."""
    views = [View(frame_at(pose, n, CAMERA), pose) for n, pose in enumerate(path(6, 0.03, 2.0))]
    return Scene("room", [views[n] for n in (0, 1, 3, 5)], [views[2], views[4]])


def moving_truth(period_ns: int) -> Trajectory:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, 2.0]
    return Trajectory(np.arange(3) * period_ns, poses)


def test_the_true_pose_lies_between_its_neighbours():
    truth = moving_truth(10 * MILLISECOND_NS)
    assert map_quality.pose_at(truth, 10 * MILLISECOND_NS)[0, 3] == 1.0
    assert map_quality.pose_at(truth, 15 * MILLISECOND_NS)[0, 3] == pytest.approx(1.5)


def test_there_is_no_true_pose_outside_or_in_a_gap():
    truth = moving_truth(200 * MILLISECOND_NS)
    assert map_quality.pose_at(truth, -1) is None
    assert map_quality.pose_at(truth, 401 * MILLISECOND_NS) is None
    assert map_quality.pose_at(truth, 300 * MILLISECOND_NS) is None
    assert map_quality.pose_at(truth, 200 * MILLISECOND_NS + 1000) is not None


def test_the_asked_camera_looks_through_the_asked_pixels():
    frame = RgbdFrame(
        0, np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 1.0, np.float32), CAMERA
    )
    rows, columns, depth_m = map_quality.asked_pixels(frame, SENSOR)
    wanted = CAMERA.ray_directions(columns, rows)
    got = map_quality.asked_camera(CAMERA).pixel_directions().reshape(-1, 3)
    assert len(depth_m) == len(got)
    np.testing.assert_allclose(got, wanted, atol=1e-6)


def test_pixels_out_of_range_are_not_asked_for():
    depth_m = np.full((120, 160), 1.0, np.float32)
    depth_m[:, :80], depth_m[:60, 80:] = 0.0, 9.0
    frame = RgbdFrame(0, np.zeros((120, 160, 3), np.uint8), depth_m, CAMERA)
    rows, columns, asked_m = map_quality.asked_pixels(frame, SENSOR)
    assert (asked_m == 1.0).all()
    assert rows.min() >= 60
    assert columns.min() >= 80


def test_a_keyframe_is_due_after_motion_only(scene):
    config = MeslamConfig().keyframes
    first = scene.keyframes[0]
    assert not map_quality.shows_more(first, first, config, SENSOR)
    moved = first.T_map_camera.copy()
    moved[0, 3] += 1.1 * config.translation_m
    assert map_quality.shows_more(first, View(first.frame, moved), config, SENSOR)


def attempt(method: str, depths: list[float], settings: str = "") -> Attempt:
    color = np.full((len(depths), 3), 0.5, np.float32)
    return Attempt(method, settings, 1.0, 0, Answers(np.array(depths, np.float32), color))


TRUTH = Answers(np.ones(4, np.float32), np.full((4, 3), 0.6, np.float32))


def test_a_hole_costs_ten_centimetres_everywhere_and_nothing_where_all_answer():
    holed = attempt("a", [1.01, 1.02, 1.03, np.nan])
    whole = attempt("b", [1.0, 1.0, 1.0, 2.0])
    first, second = map_quality.scores("s", [holed, whole], TRUTH)
    assert (first.answered, second.answered) == (0.75, 1.0)
    assert first.median_cm == pytest.approx(2.0, abs=1e-3)
    assert first.clipped_cm == pytest.approx(2.0, abs=1e-3)
    assert first.all_clipped_cm == pytest.approx((1 + 2 + 3 + 10) / 4, abs=1e-3)
    assert first.bias_cm == pytest.approx(2.0, abs=1e-3)
    assert second.clipped_cm == 0.0
    assert second.all_clipped_cm == pytest.approx(2.5)
    assert first.psnr_db == pytest.approx(20.0, abs=1e-3)


def test_the_best_settings_of_a_method_count():
    tried = [attempt("a", [1.02] * 4, "bad"), attempt("a", [1.01] * 4, "good")]
    (only,) = map_quality.scores("s", tried, TRUTH)
    assert only.settings == "good"


def test_the_seed_in_the_middle_counts():
    runs = [attempt("a", [1 + error] * 4, str(error)) for error in (0.03, 0.01, 0.02)]
    assert map_quality.middle(runs, TRUTH).settings == "0.02"


def test_rays_end_at_the_first_known_surface():
    """A wall at x = 2 m, and one nearer that nobody has seen."""
    level = surface_level(MeslamConfig().field)

    def values(points):
        distance = np.clip((points[:, 0] - 2.0) / 0.1 + level, -1.0, 1.0)
        unknown = (points[:, 0] > 1.0) & (points[:, 0] < 1.2)
        return SimpleNamespace(distance=np.where(unknown, np.nan, distance))

    wall = SimpleNamespace(
        surface_level=level, values=values, color=lambda points: np.full((len(points), 3), 0.25)
    )
    directions = np.array([[1, 0, 0], [1, 0.5, 0], [-1, 0, 0]], np.float32)
    depth_m, color = map_quality.first_surface(wall, np.zeros(3), directions, 5.0)
    np.testing.assert_allclose(depth_m[:2], 2.0, atol=0.002)
    assert np.isnan(depth_m[2])
    np.testing.assert_allclose(color[:2], 0.25)


def test_the_tsdf_is_exact_on_exact_views(scene):
    """Half a pixel or half a voxel off would show as a bias."""
    truth = map_quality.measured(scene, SENSOR)
    tried = list(map_quality.tsdf_attempts(scene, 0.02, SENSOR))
    (result,) = map_quality.scores("room", tried, truth)
    assert result.answered > 0.85
    assert result.median_cm < 0.15
    assert abs(result.bias_cm) < 0.05
    assert result.psnr_db > 18


def test_ours_learns_with_the_poses_held(scene):
    config = MeslamConfig()
    truth = map_quality.measured(scene, SENSOR)
    found = map_quality.scores(
        "room", list(map_quality.neural_attempts(scene, config, [0.3, 1.5], 0)), truth
    )
    assert [each.cpu_s for each in found] == pytest.approx([0.3, 1.5], abs=0.3)
    assert found[1].steps > found[0].steps
    assert found[1].median_cm < found[0].median_cm
    assert found[1].answered > 0.95
    mapper = map_quality.NeuralMapper(scene, config, 0)
    mapper.train_until(0.2)
    held = mapper.optimizer.keyframes
    for number, view in enumerate(scene.keyframes):
        np.testing.assert_allclose(held.pose(number), view.T_map_camera, atol=1e-6)


def test_the_verdict_names_the_worse():
    ours = map_quality.ours(map_quality.DECIDING_S)
    peer = map_quality.tsdf(0.01)
    found = map_quality.scores("s", [attempt(ours, [1.02] * 4), attempt(peer, [1.01] * 4)], TRUTH)
    assert "WORSE" in map_quality.verdicts(found)[0]
    found = map_quality.scores("s", [attempt(ours, [1.01] * 4), attempt(peer, [1.02] * 4)], TRUTH)
    assert "no worse" in map_quality.verdicts(found)[0]
