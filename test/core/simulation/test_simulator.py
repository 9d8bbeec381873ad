"""Simulated recordings: truth, determinism, files."""

from __future__ import annotations

import cv2
import numpy as np
import open3d as o3d
import pytest

from meslam_core.errors import ConfigError, OutputError, RecordingError
from meslam_core.evaluation.reconstruction import distances
from meslam_core.recordings.recording import Recording
from meslam_core.recordings.registry import open_recording
from meslam_core.se3 import inverse
from meslam_core.simulation import lighting
from meslam_core.simulation.scenes import build_scene
from meslam_core.simulation.sensor import D435_CAMERA
from meslam_core.simulation.simulator import Simulation, simulate
from meslam_core.simulation.writer import surface_path, truth_path, write_simulation
from meslam_core.trajectory import read_tum

CAMERA = D435_CAMERA.scaled(0.25)


def small(
    seed: int = 0, duration_s: float = 20.0, noise: bool = True, blur: float = 0.0
) -> Simulation:
    return simulate("room", duration_s, seed, CAMERA, noise=noise, motion_blur_s=blur)


def test_simulation_is_a_recording():
    simulation = small(duration_s=1.0)
    assert isinstance(simulation, Recording)
    frames = list(simulation.frames(1, 8, 3))
    assert len(simulation) == 15
    assert [frame.stamp_ns for frame in frames] == list(simulation.stamps_ns[1:8:3])
    np.testing.assert_allclose(np.diff(simulation.stamps_ns), 1e9 / 15, atol=1)
    assert frames[0].camera == CAMERA
    simulation.close()


def test_frames_do_not_depend_on_the_order_of_reading():
    forward = list(small().frames(40, 44))
    backward = [small().frame(index) for index in (43, 42, 41, 40)][::-1]
    for one, other in zip(forward, backward, strict=True):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_seed_changes_noise_and_path_but_not_the_space():
    one, other = small(seed=1), small(seed=2)
    assert np.any(one.frame(0).color != other.frame(0).color)
    assert one.surface is other.surface
    first, second = one.ideal_view(0), other.ideal_view(0)
    # Paths start within a tremor of each other.
    assert np.median(np.abs(first.depth_m - second.depth_m)) < 0.05


def test_depth_and_true_poses_put_points_on_the_surface():
    simulation = small(noise=False)
    for index in (0, 120, 299):
        frame = simulation.frame(index)
        points = frame.camera.back_project(frame.depth_m)[frame.depth_m > 0]
        pose = simulation.truth.poses[index]
        on_surface = points @ pose[:3, :3].T + pose[:3, 3]
        off = distances(on_surface, simulation.surface)
        assert np.percentile(off, 98) < 1e-4
        # Distances to slivers such as the skirting's top are inexact in single precision.
        assert off.max() < 4e-3


def test_noisy_depth_scatters_about_the_true_depth():
    simulation = small()
    true, measured = simulation.ideal_view(100).depth_m, simulation.frame(100).depth_m
    seen = measured > 0
    assert 0.85 < seen.mean() < 0.99
    error = (measured - true)[seen]
    assert abs(np.median(error)) < 0.005
    assert 0.002 < np.median(np.abs(error)) < 0.03


def test_colors_of_a_point_agree_between_views():
    """A view warped with depth and truth into another shows the same colours."""
    simulation = small(noise=False)
    first, second = simulation.frame(100), simulation.frame(103)
    T_first_second = inverse(simulation.truth.poses[100]) @ simulation.truth.poses[103]
    points = CAMERA.back_project(second.depth_m).reshape(-1, 3)
    moved = points @ T_first_second[:3, :3].T + T_first_second[:3, 3]
    u, v, z = CAMERA.project(moved)
    size = second.depth_m.shape
    maps = [np.asarray(a, np.float32).reshape(size) for a in (u, v)]
    warped = cv2.remap(first.color, *maps, cv2.INTER_LINEAR)
    expected_depth = cv2.remap(first.depth_m, *maps, cv2.INTER_LINEAR)
    visible = np.abs(expected_depth - z.reshape(size)) < 0.01
    assert visible.mean() > 0.7
    difference = np.abs(warped.astype(float) - second.color).mean(axis=2)[visible]
    still = np.abs(first.color.astype(float) - second.color).mean()
    assert np.median(difference) < 3.0
    assert difference.mean() < 0.35 * still


def test_without_a_duration_the_camera_goes_round_once():
    simulation = simulate("corridor", camera=CAMERA)
    assert len(simulation) == round(build_scene("corridor").route.round_s * simulation.fps)
    first, last = simulation.truth.poses[[0, -1]]
    assert np.linalg.norm(first[:3, 3] - last[:3, 3]) < 0.05


def test_building_shows_itself_lit_and_patterned_all_along_the_way(monkeypatch):
    # Soft shadows take most of the time, and nothing here depends on them. The scale is nobody
    # else's, so that no other test is given this light.
    monkeypatch.setattr(lighting, "NODE_SPACING_M", 1.0)
    monkeypatch.setattr(lighting, "SKY_SAMPLES", 4)
    monkeypatch.setattr(lighting, "LAMP_SIDE_SAMPLES", 1)
    simulation = simulate("building", seed=3, camera=D435_CAMERA.scaled(0.125))
    frames = list(simulation.frames(0, None, len(simulation) // 24))
    brightness = np.array([frame.color.mean() for frame in frames])
    assert brightness.min() > 50
    assert brightness.max() < 220
    assert min(frame.color.std(axis=(0, 1)).max() for frame in frames) > 10
    # Nothing is farther away than the building is long, and most of it can be measured.
    depths = [frame.depth_m[frame.depth_m > 0] for frame in frames]
    assert max(depth.max() for depth in depths) < 28
    assert np.median([len(depth) for depth in depths]) > 0.7 * frames[0].depth_m.size


def test_corridor_has_little_texture():
    def textured_share(name: str) -> float:
        frames = simulate(name, camera=CAMERA, noise=False).frames(0, None, 60)
        return float(np.mean([np.abs(cv2.Laplacian(f.color, cv2.CV_32F)) > 15 for f in frames]))

    assert textured_share("corridor") < 0.5 * textured_share("room")


def test_motion_blur_smears_along_the_motion_only_on_request():
    sharp, smeared = small(noise=False).frame(100), small(noise=False, blur=0.06).frame(100)
    np.testing.assert_array_equal(sharp.depth_m, smeared.depth_m)

    def sharpness(image: np.ndarray) -> float:
        return float(cv2.Laplacian(image.astype(np.float32), cv2.CV_32F).std())

    assert sharpness(smeared.color) < 0.8 * sharpness(sharp.color)


def test_most_surfaces_are_within_the_camera_range():
    depths = np.concatenate([frame.depth_m.ravel() for frame in small().frames(0, None, 50)])
    low, high = np.percentile(depths[depths > 0], [1, 99])
    assert low > 0.5
    assert high < 4.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "moon", "duration_s": 1.0}, "no scene 'moon'"),
        ({"scene": "room", "duration_s": 0.0}, "must be positive"),
        ({"scene": "room", "duration_s": 1.0, "fps": -1.0}, "must be positive"),
        ({"scene": "room", "duration_s": 1.0, "seed": -1}, "neither may be negative"),
    ],
)
def test_impossible_simulations_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        simulate(**arguments)


def test_missing_frame_is_refused():
    with pytest.raises(RecordingError, match="no frame 15"):
        small(duration_s=1.0).frame(15)


def test_written_simulation_reads_back_with_its_truth_beside_it(tmp_path):
    simulation = small(duration_s=0.6)
    target = tmp_path / "bags" / "room.mcap"
    calls = []
    write_simulation(simulation, target, lambda done, total: calls.append((done, total)))
    assert calls[-1] == (9, 9)
    assert sorted(path.name for path in target.parent.iterdir()) == [
        "room.mcap",
        "room.surface.ply",
        "room.truth.txt",
    ]
    recording = open_recording(target)
    assert len(recording) == 9
    for read, made in zip(recording.frames(), simulation.frames(), strict=True):
        np.testing.assert_array_equal(read.color, made.color)
        np.testing.assert_allclose(read.depth_m, made.depth_m, atol=1e-6)
        assert read.stamp_ns == made.stamp_ns
    assert recording.camera == CAMERA
    truth = read_tum(truth_path(target))
    np.testing.assert_array_equal(truth.stamps_ns, simulation.stamps_ns)
    np.testing.assert_allclose(truth.poses, simulation.truth.poses, atol=1e-8)
    surface = o3d.io.read_triangle_mesh(surface_path(target))
    assert len(surface.triangles) == len(simulation.surface.triangles)


def test_interrupted_writing_leaves_nothing(tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_simulation(small(duration_s=0.6), tmp_path / "room.mcap", stop)
    assert not list(tmp_path.iterdir())


def test_target_must_be_a_writable_mcap(tmp_path):
    with pytest.raises(OutputError, match=r"ends in \.mcap"):
        write_simulation(small(duration_s=0.2), tmp_path / "room.bag")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/room\.mcap cannot be written"):
        write_simulation(small(duration_s=0.2), tmp_path / "file" / "room.mcap")
