"""Regions beyond the ordinary: what they see outside their boxes, and frames that were moved."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.stored_region import snapshot
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import rays_at
from meslam_core.se3 import exp
from meslam_core.tracking.field_tracker import FieldTracker
from meslam_core.tracking.pixels import trusted_pixels

SMALL_BOX_M3 = 6.0


@pytest.fixture(scope="module")
def room(build_room):
    """The room in a region so small that most of the walls lie outside its box."""
    overrides = (f"regions.volume_m3={SMALL_BOX_M3}", "regions.mask_extent=4.0")
    return build_room(700, overrides)


def test_what_is_seen_beyond_the_box_is_in_the_map(room):
    region = room.region
    neural_map = NeuralMap([snapshot(region, 0)], room.config.map)
    seen = np.concatenate([room.keyframes.points(np.array([k])) for k in region.keyframes])
    seen = seen.reshape(-1, 3).astype(np.float64)
    outside = np.abs(seen - region.T_map_region[:3, 3]).max(axis=1) > region.half_side_m
    assert outside.mean() > 0.3
    distance = neural_map.signed_distance_m(seen[outside])
    assert np.isfinite(distance).mean() > 0.95
    assert np.nanmedian(np.abs(distance)) < 0.02
    assert neural_map.bounds[1].max() > region.half_side_m + 0.2


def test_a_region_that_is_turned_and_shifted_is_trained_tracked_and_asked_like_any(build_room):
    room = build_room(1, ("regions.mask_extent=2.0",))
    region = room.region
    region.T_map_region = exp(np.array([0.2, -0.1, 0.1, 0.1, -0.2, 0.5])) @ region.T_map_region
    room.atlas.rebuild_mask(region)
    optimizer = JointOptimizer(room.keyframes, room.config.mapping, seed=0)
    for rate_factor in (1.0, 0.2, 0.05):
        optimizer.train(region, 300, refine_poses=False, rate_factor=rate_factor)
    seen = room.keyframes.points(np.array(region.keyframes)).reshape(-1, 3).astype(np.float64)
    neural_map = NeuralMap([snapshot(region, 0)], room.config.map)
    assert np.nanmedian(np.abs(neural_map.signed_distance_m(seen))) < 0.01
    frame, pose = room.frame(15), room.poses[15]
    rays = rays_at(frame, *np.nonzero(trusted_pixels(frame.depth_m, room.config.sensor)))
    off = exp(np.array([0.02, -0.01, 0.01, 0.0, 0.01, -0.01])) @ pose
    found = FieldTracker(room.config.tracking).align(region, rays, off).T_map_camera
    assert np.linalg.norm(found[:3, 3] - pose[:3, 3]) < 0.01
