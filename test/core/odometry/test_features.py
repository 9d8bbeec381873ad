"""Motions that matched features propose, from views of finely patterned walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from data.textured_room import CAMERA, frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.odometry import make_registrar
from meslam_core.odometry.features import Features, find_features, propose_motion
from meslam_core.se3 import Pose, exp, inverse, log

LARGE = CAMERA.scaled(2.0)
START = path(1)[0]
TILE_M = 0.03
BRIGHTNESS = np.random.default_rng(0).integers(20, 235, 1 << 16, dtype=np.uint8)
FACTORS = np.array([73856093, 19349663, 83492791])
TURN = np.deg2rad(12.0)
# 20 cm and 12 degrees each.
LARGE_MOTIONS = [
    np.array([0.2, 0.0, 0.0, 0.0, -TURN, 0.0]),
    np.array([0.0, 0.0, 0.2, 0.0, TURN, 0.0]),
    np.array([0.1, 0.1, 0.14, 0.0, TURN, 0.0]),
]
# Beyond the reach of registration from no guess.
HARD_MOTION = np.array([0.15, -0.1, 0.08, 0.4 * TURN, 0.8 * TURN, -0.4 * TURN])


def tiled_view(pose: Pose) -> RgbdFrame:
    """The view from a pose in the room, its surfaces covered with tiles of random brightness."""
    frame = frame_at(pose, 0, LARGE)
    points = LARGE.back_project(frame.depth_m).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    cells = np.floor(points / TILE_M + 0.37).astype(np.int64) + 1000
    gray = BRIGHTNESS[(cells @ FACTORS) % len(BRIGHTNESS)].reshape(frame.depth_m.shape)
    return replace(frame, color=np.repeat(gray[..., None], 3, axis=2))


def features(frame: RgbdFrame) -> Features:
    return find_features(np.ascontiguousarray(frame.color[..., 0]), frame.depth_m, frame.camera)


@pytest.fixture(scope="module")
def start_view() -> RgbdFrame:
    return tiled_view(START)


@pytest.fixture(scope="module")
def start_features(start_view) -> Features:
    return features(start_view)


@pytest.mark.parametrize("twist", LARGE_MOTIONS, ids=["aside", "forward", "oblique"])
def test_a_large_motion_is_proposed(start_features, twist):
    motion = exp(twist)
    proposed = propose_motion(features(tiled_view(START @ motion)), start_features)
    assert proposed is not None
    error = log(inverse(motion) @ proposed)
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.rad2deg(np.linalg.norm(error[3:])) < 2.0
    np.testing.assert_allclose(proposed[:3, :3] @ proposed[:3, :3].T, np.eye(3), atol=1e-6)


def test_registration_finds_a_large_motion_from_what_is_proposed(start_view):
    config = MeslamConfig()
    registrar = make_registrar(config.odometry, config.sensor)
    motion = exp(HARD_MOTION)
    source, target = registrar.prepare(tiled_view(START @ motion)), registrar.prepare(start_view)
    (proposed,) = registrar.propose(source, target)
    found = registrar.register(source, target, proposed)
    assert np.linalg.norm(log(inverse(motion) @ found.T_target_source)[:3]) < 0.005
    lost = registrar.register(source, target, np.eye(4))
    assert np.linalg.norm(log(inverse(motion) @ lost.T_target_source)[:3]) > 0.05


def test_features_lie_on_the_surface_they_show(start_view, start_features):
    assert len(start_features.pixels) > 300
    assert start_features.measured.all()
    u, v, z = LARGE.project(start_features.points.astype(np.float64))
    np.testing.assert_allclose(np.stack([u, v], axis=1), start_features.pixels, atol=1e-3)
    columns, rows = np.rint(start_features.pixels).astype(int).T
    np.testing.assert_allclose(z, start_view.depth_m[rows, columns], rtol=1e-6)


def test_blank_images_propose_nothing(start_view, start_features):
    blank = features(replace(start_view, color=np.full_like(start_view.color, 128)))
    assert len(blank.pixels) == len(blank.descriptors) == len(blank.points) == 0
    assert propose_motion(blank, start_features) is None
    assert propose_motion(start_features, blank) is None
    assert propose_motion(blank, blank) is None


@pytest.mark.parametrize("missing", [0.0, np.nan], ids=["zero", "not a number"])
def test_no_depth_proposes_nothing(start_view, start_features, missing):
    empty = np.full_like(start_view.depth_m, missing)
    blind = features(replace(start_view, depth_m=empty))
    assert len(blind.pixels) == len(start_features.pixels)
    assert not blind.measured.any()
    assert propose_motion(blind, start_features) is None
    # Only the source's depth is needed.
    assert propose_motion(start_features, blind) is not None


def test_unrelated_images_propose_nothing(start_features):
    generator = np.random.default_rng(1)
    noise = generator.integers(0, 255, (LARGE.height, LARGE.width), dtype=np.uint8)
    depth_m = np.full(noise.shape, 1.5, np.float32)
    assert propose_motion(find_features(noise, depth_m, LARGE), start_features) is None
