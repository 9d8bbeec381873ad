"""Direct registration in compiled code: accuracy, reach, and what it refuses."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from data.textured_room import CAMERA, frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import HybridRegistrar, direct, make_odometry, make_registrar
from meslam_core.odometry.direct import DirectRegistrar
from meslam_core.se3 import Pose, exp, inverse, log

_kernel = pytest.importorskip("meslam_core.field._kernel", reason="needs the compiled kernel")

CONFIG = MeslamConfig()
LARGE = CAMERA.scaled(2.0)
START = path(1)[0]
MOTION = exp(np.array([0.015, -0.01, 0.02, 0.010, -0.016, 0.009]))
SIDE = 32
LIMITS = {"min_depth": 0.2, "max_depth": 5.0}
LENS = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 15.5}
SEARCH = {
    "finest": 0,
    "levels": 1,
    "iterations": 2,
    "max_distance": 0.07,
    "convergence": 1e-4,
    "correlated": 50.0,
    "luma_bias_m": 0.0,
    "luma_bias_rad": 0.0,
}


def registrar() -> DirectRegistrar:
    return DirectRegistrar(CONFIG.odometry, CONFIG.sensor)


@pytest.fixture(scope="module")
def target() -> RgbdFrame:
    return frame_at(START, 0, LARGE)


@pytest.fixture(scope="module")
def source() -> RgbdFrame:
    return frame_at(START @ MOTION, 1, LARGE)


def darkened(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, color=np.round(0.7 * frame.color + 15.0).astype(np.uint8))


def with_holes(frame: RgbdFrame, seed: int) -> RgbdFrame:
    """Half of the depth is missing, in patches as a stereo camera leaves them."""
    patches = np.random.default_rng(seed).random((30, 40)) < 0.5
    missing = np.kron(patches, np.ones((8, 8))) > 0
    return replace(frame, depth_m=np.where(missing, np.float32(0.0), frame.depth_m))


def errors(found: Pose, true: Pose) -> tuple[float, float]:
    """Distance [m] and angle [deg]."""
    twist = log(inverse(true) @ found)
    return float(np.linalg.norm(twist[:3])), float(np.rad2deg(np.linalg.norm(twist[3:])))


def register(source: RgbdFrame, target: RgbdFrame, search: bool = False):
    used = registrar()
    prepared, start = (used.prepare(source), used.prepare(target)), np.eye(4)
    return used.register(*prepared, used.search(*prepared, start) if search else start)


def pyramid(**changed):
    arguments = {
        "gray": np.zeros((SIDE, SIDE), np.uint8),
        "depth": np.ones((SIDE, SIDE), np.float32),
        **LIMITS,
        **LENS,
        "halvings": 0,
        "levels": 2,
        **changed,
    }
    return _kernel.RgbdPyramid(**arguments)


@pytest.mark.parametrize(
    ("change_source", "change_target"),
    [
        (lambda frame: frame, lambda frame: frame),
        (darkened, lambda frame: frame),
        (lambda frame: frame, darkened),
        (lambda frame: with_holes(frame, 1), lambda frame: with_holes(frame, 2)),
    ],
    ids=["plain", "source darker", "target darker", "half of the depth"],
)
def test_a_known_motion_is_found(source, target, change_source, change_target):
    found = register(change_source(source), change_target(target))
    distance, angle = errors(found.T_target_source, MOTION)
    assert distance < 0.003
    assert angle < 0.1
    assert found.fitness > 0.8
    assert found.agreement > 0.6
    assert found.residual_m < 0.01


def test_scattered_holes_leave_the_motion(source, target):
    missing = np.random.default_rng(3).random(source.depth_m.shape) < 0.5
    holed = replace(source, depth_m=np.where(missing, np.float32(0.0), source.depth_m))
    found = register(holed, target)
    assert errors(found.T_target_source, MOTION)[0] < 0.003


@pytest.mark.parametrize("axis", [3, 4], ids=["pitch", "yaw"])
def test_the_search_finds_a_turn_beyond_the_reach_of_registration(target, axis):
    turn = exp(np.deg2rad(12.0) * np.eye(6)[axis])
    turned = frame_at(START @ turn, 1, LARGE)
    narrow, wide = register(turned, target), register(turned, target, search=True)
    distance, angle = errors(wide.T_target_source, turn)
    assert distance < 0.003
    assert angle < 0.1
    assert errors(narrow.T_target_source, turn)[0] > 0.03
    assert wide.agreement > 0.6 > narrow.agreement


def test_registration_is_repeatable(source, target):
    first, second = register(source, target), register(source, target)
    np.testing.assert_array_equal(first.T_target_source, second.T_target_source)
    np.testing.assert_array_equal(first.information, second.information)


def test_frames_without_depth_fit_nothing(source, target):
    blind = replace(source, depth_m=np.zeros_like(source.depth_m))
    for pair in ((blind, target), (source, blind)):
        found = register(*pair)
        assert found.fitness == 0.0
        assert found.agreement == 0.0
        assert np.isfinite(found.T_target_source).all()


@pytest.mark.parametrize(
    ("changed", "error", "named"),
    [
        ({"gray": np.zeros((SIDE, SIDE), np.float32)}, TypeError, "gray"),
        ({"gray": np.zeros((SIDE, SIDE, 3), np.uint8)}, TypeError, "gray"),
        ({"gray": np.zeros((SIDE, 2 * SIDE), np.uint8)[:, ::2]}, TypeError, "gray"),
        ({"gray": np.zeros((SIDE, 4), np.uint8)}, ValueError, "gray"),
        ({"depth": np.ones((SIDE, SIDE))}, TypeError, "depth"),
        ({"depth": np.ones((SIDE, SIDE - 1), np.float32)}, ValueError, "depth"),
        ({"depth": np.ones(SIDE * SIDE, np.float32)}, ValueError, "depth"),
        ({"levels": 0}, ValueError, "levels"),
        ({"halvings": -1}, ValueError, "halvings"),
        ({"fx": 0.0}, ValueError, "fx"),
        ({"fy": float("nan")}, ValueError, "fy"),
    ],
)
def test_wrong_images_are_refused(changed, error, named):
    with pytest.raises(error, match=named):
        pyramid(**changed)


def test_a_pyramid_has_the_levels_asked_for():
    assert pyramid(levels=2).levels == 2


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"levels": 0}, "levels"),
        ({"finest": -1}, "finest"),
        ({"iterations": 0}, "iterations"),
        ({"correlated": 0.5}, "correlated"),
        ({"correlated": float("nan")}, "correlated"),
    ],
)
def test_wrong_settings_are_refused(changed, named):
    with pytest.raises(ValueError, match=named):
        _kernel.align_rgbd(pyramid(), pyramid(), np.eye(4), **{**SEARCH, **changed})


@pytest.mark.parametrize("shape", [(3, 4), (16,), (1, 4, 4)])
def test_a_guess_that_is_no_pose_is_refused(shape):
    with pytest.raises(ValueError, match="T_target_source"):
        _kernel.align_rgbd(pyramid(), pyramid(), np.zeros(shape), **SEARCH)


def test_only_pyramids_are_aligned():
    with pytest.raises(TypeError, match="align_rgbd"):
        _kernel.align_rgbd(np.zeros((SIDE, SIDE)), pyramid(), np.eye(4), **SEARCH)


def test_without_the_extension_open3d_takes_over_and_says_why(monkeypatch, caplog):
    monkeypatch.setattr(direct, "_import_error", "no module named _kernel")
    with caplog.at_level(logging.WARNING, "meslam_core"):
        follower = make_odometry(CONFIG.odometry, CONFIG.sensor)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "no module named _kernel" in record.getMessage()
    assert "hybrid" in record.getMessage()
    for number, pose in enumerate([START, START @ MOTION]):
        estimate = follower.process(frame_at(pose, number, CAMERA))
    assert estimate.valid
    assert errors(estimate.T_odom_camera, MOTION)[0] < 0.01
    assert isinstance(make_registrar(CONFIG.odometry, CONFIG.sensor), HybridRegistrar)


def test_with_the_extension_nobody_is_warned(caplog):
    with caplog.at_level(logging.WARNING, "meslam_core"):
        used = make_registrar(CONFIG.odometry, CONFIG.sensor)
    assert isinstance(used, DirectRegistrar)
    assert not caplog.records
