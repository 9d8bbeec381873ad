"""Which keyframes train a region."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meslam_core.config import MeslamConfig
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.regions.grid import RegionGrid
from meslam_core.regions.inheritance import first_region, region_beside
from meslam_core.regions.region import Region
from meslam_core.regions.region_keyframes import RegionKeyframes

CONFIG = MeslamConfig.from_overrides(["field.backend=torch", "regions.mask_voxel_m=0.2"])
GRID = RegionGrid.around(np.zeros(3), CONFIG.regions)
HALF_M = 0.5 * GRID.side_m
RAYS = 64
UPWARDS = np.array([0.0, 0.0, 5.0 * HALF_M])


@pytest.fixture
def keyframes() -> KeyframeStore:
    return KeyframeStore(RAYS, torch.device("cpu"))


@pytest.fixture
def region() -> Region:
    return first_region((0, 0, 0), GRID, CONFIG, seed=0)


def add(keyframes: KeyframeStore, half_sides: float, share: float) -> int:
    """A keyframe so far from the first region's centre, which sees this share of its points there.

    It sees the others far above itself.
    """
    position = np.array([half_sides * HALF_M, 0.0, 0.0])
    ways = np.tile(UPWARDS, (RAYS, 1))
    ways[: round(share * RAYS)] = -position + np.array([0.0, 0.0, 0.1])
    lengths = np.linalg.norm(ways, axis=1, keepdims=True)
    pose = np.eye(4)
    pose[:3, 3] = position
    rays = Rays(
        torch.from_numpy((ways / lengths).astype(np.float32)),
        torch.from_numpy(lengths[:, 0].astype(np.float32)),
        torch.zeros(RAYS, 3),
    )
    return keyframes.add(len(keyframes), pose, rays)


@pytest.mark.parametrize(
    ("half_sides", "share", "continued", "met"),
    [
        (0.9, 0.0, True, True),
        (1.5, 0.9, True, True),
        # From the other side of a wall, say: mostly another room.
        (1.5, 0.3, True, False),
        (2.5, 1.0, True, False),
        (1.5, 0.05, False, False),
    ],
)
def test_later_on_only_views_that_show_little_else_train_a_region(
    keyframes, region, half_sides, share, continued, met
):
    """At first all that show a part of it do, of which its network has inherited what they show."""
    number = add(keyframes, half_sides, share)
    views = RegionKeyframes(keyframes)
    parent = first_region((1, 0, 0), GRID, CONFIG, seed=0)
    parent.keyframes = [add(keyframes, 9.0, 0.0)]
    new = first_region((0, 0, 0), GRID, CONFIG, seed=0)
    views.assign(new, parent, observed_alike=True)
    views.meet(region)
    assert (number in new.keyframes) == continued
    assert (number in region.keyframes) == met


def test_where_the_path_is_in_doubt_a_new_region_replays_its_parents_views_until_that_is_settled(
    keyframes, region
):
    views = RegionKeyframes(keyframes)
    before = add(keyframes, 1.2, 0.0)
    since = add(keyframes, 0.8, 0.0)
    region.keyframes = [since]
    beside = region_beside(region, (1, 0, 0), GRID, CONFIG, seed=0)
    views.assign(beside, region, observed_alike=True, in_doubt=True)
    assert beside.keyframes == [since]
    views.meet(beside)
    assert beside.keyframes == [before, since]
    assert beside.unmarked == [before]


def test_a_region_without_any_view_of_its_own_begins_with_its_parents_latest(keyframes, region):
    region.keyframes = [add(keyframes, -0.9, 0.0), add(keyframes, -0.8, 0.0)]
    beside = region_beside(region, (1, 0, 0), GRID, CONFIG, seed=0)
    RegionKeyframes(keyframes).assign(beside, region, observed_alike=True)
    assert beside.keyframes == region.keyframes[-1:]
