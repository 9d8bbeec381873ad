"""A surface outside every region that the camera entered is in the map all the same."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.stored_region import snapshot

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
