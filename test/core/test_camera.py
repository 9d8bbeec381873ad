"""The pinhole camera and the registration of depth to colour."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from meslam_core.camera import PinholeCamera, register_depth_to_color
from meslam_core.errors import FrameError
from meslam_core.frame import RgbdFrame, depth_to_metres

CAMERA = PinholeCamera(64, 48, 60.0, 62.0, 31.0, 23.5)


@given(st.floats(0, 63), st.floats(0, 47), st.floats(0.1, 20))
def test_projection_undoes_back_projection(u, v, depth):
    point = CAMERA.ray_directions(np.array([u]), np.array([v])).astype(np.float64) * depth
    projected = np.concatenate(CAMERA.project(point))
    np.testing.assert_allclose(projected, [u, v, depth], rtol=1e-5, atol=1e-4)


def test_points_behind_the_camera_project_nowhere():
    u, v, z = CAMERA.project(np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0]]))
    assert np.isnan(u).all()
    assert np.isnan(v).all()
    assert (z <= 0).all()


def test_back_projected_depth_keeps_its_depth_and_holes_stay_at_the_origin():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[3, 4] = 0.0
    points = CAMERA.back_project(depth)
    np.testing.assert_allclose(points[..., 2], depth)
    np.testing.assert_array_equal(points[3, 4], 0.0)
    np.testing.assert_allclose(points[10, 31, 0], 0.0, atol=1e-6)


def test_back_projection_refuses_an_image_of_another_size():
    with pytest.raises(FrameError, match="32x24"):
        CAMERA.back_project(np.ones((24, 32), np.float32))


def test_a_scaled_camera_sees_the_same_rays():
    half = CAMERA.scaled(0.5)
    assert (half.width, half.height) == (32, 24)
    # The centre of a pixel of the small image is the corner between four of the large one.
    small = half.ray_directions(np.array([10.0]), np.array([7.0]))
    np.testing.assert_allclose(
        small, CAMERA.ray_directions(np.array([20.5]), np.array([14.5])), atol=1e-6
    )


@pytest.mark.parametrize(
    "change",
    [{"fx": 0.0}, {"fy": -1.0}, {"cx": np.nan}, {"width": 0}, {"fx": np.inf}],
)
def test_unusable_intrinsics_are_refused(change):
    with pytest.raises(FrameError, match="intrinsics are unusable"):
        PinholeCamera(**(CAMERA.to_dict() | change))


def test_camera_json_round_trip(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(CAMERA.to_dict() | {"depth_scale": "ignored"}))
    assert PinholeCamera.from_json(file) == CAMERA


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"width": 3}', '{"width": "wide"}'])
def test_camera_json_says_what_it_should_hold(tmp_path, text):
    file = tmp_path / "camera.json"
    file.write_text(text)
    with pytest.raises(FrameError, match=r"camera\.json.*width, height, fx, fy, cx, cy"):
        PinholeCamera.from_json(file)


def test_unusable_intrinsics_name_their_file(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(CAMERA.to_dict() | {"fy": 0}))
    with pytest.raises(FrameError, match=r"camera\.json.*unusable"):
        PinholeCamera.from_json(file)


def test_missing_camera_json_is_named(tmp_path):
    with pytest.raises(FrameError, match=r"nowhere\.json"):
        PinholeCamera.from_json(tmp_path / "nowhere.json")


def test_registration_without_motion_is_the_identity():
    depth = np.random.default_rng(0).uniform(1, 3, (48, 64)).astype(np.float32)
    np.testing.assert_allclose(register_depth_to_color(depth, CAMERA, CAMERA, np.eye(4)), depth)


def test_registration_shifts_a_plane_by_its_disparity():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[20, 30] = 0.0
    T_color_depth = np.eye(4)
    # 60 px * 0.2 m / 2 m = 6 px
    T_color_depth[0, 3] = 0.2
    registered = register_depth_to_color(depth, CAMERA, CAMERA, T_color_depth)
    np.testing.assert_allclose(registered[:20, 6:], 2.0, atol=1e-6)
    np.testing.assert_array_equal(registered[:, :6], 0.0)
    assert registered[20, 36] == 0.0


def test_registration_keeps_the_nearest_of_several_surfaces():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[:, 20:30] = 1.0
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.1
    # The near part moves by 6 px, the far one by 1.5: they overlap.
    registered = register_depth_to_color(depth, CAMERA, CAMERA, T_color_depth)
    np.testing.assert_allclose(registered[24, 26:36], 1.0)


def test_registration_fills_a_finer_colour_image():
    depth = np.full((24, 32), 2.0, np.float32)
    coarse = CAMERA.scaled(0.5)
    registered = register_depth_to_color(depth, coarse, CAMERA, np.eye(4))
    assert np.mean(registered > 0) > 0.95


def test_registration_along_the_optical_axis_changes_the_depth():
    depth = np.full((48, 64), 2.0, np.float32)
    T_color_depth = np.eye(4)
    T_color_depth[2, 3] = -0.5
    registered = register_depth_to_color(depth, CAMERA, CAMERA, T_color_depth)
    assert registered[24, 32] == pytest.approx(1.5)


def test_frames_refuse_images_that_do_not_fit_the_camera():
    color, depth = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32)
    RgbdFrame(0, color, depth, CAMERA)
    with pytest.raises(FrameError, match="colour image"):
        RgbdFrame(0, color[:40], depth, CAMERA)
    with pytest.raises(FrameError, match="registered to colour"):
        RgbdFrame(0, color, depth[:, :60], CAMERA)
    with pytest.raises(FrameError, match="uint16"):
        RgbdFrame(0, color, depth.astype(np.uint16), CAMERA)


def test_depth_in_millimetres_and_metres():
    np.testing.assert_allclose(
        depth_to_metres(np.array([[0, 1500]], np.uint16)), [[0.0, 1.5]], rtol=1e-6
    )
    metres = depth_to_metres(np.array([[np.nan, -1.0, np.inf, 1.5]], np.float32))
    np.testing.assert_array_equal(metres, np.array([[0.0, 0.0, 0.0, 1.5]], np.float32))


@pytest.mark.parametrize("raw", [np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint16)])
def test_other_depth_encodings_are_refused(raw):
    with pytest.raises(FrameError, match="expected"):
        depth_to_metres(raw)
