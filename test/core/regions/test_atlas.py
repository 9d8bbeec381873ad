"""Creating, inheriting, waking and switching regions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region

CONFIG = MeslamConfig.from_overrides(
    ["field.backend=torch", "keyframes.rays=512", "regions.mask_voxel_m=0.1"]
)


@pytest.fixture
def atlas() -> RegionAtlas:
    """One region about the origin with a keyframe that looks along x."""
    keyframes = KeyframeStore(512, torch.device("cpu"))
    atlas = RegionAtlas(CONFIG, np.zeros(3), keyframes, seed=0)
    add_keyframe(atlas, path(1)[0])
    return atlas


def add_keyframe(atlas: RegionAtlas, pose: np.ndarray) -> int:
    frame = frame_at(pose)
    generator = np.random.default_rng(0)
    rows, columns = generator.integers(0, 120, 512), generator.integers(0, 160, 512)
    number = atlas.keyframes.add(0, pose, rays_at(frame, rows, columns))
    atlas.add_keyframe(number)
    return number


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """A position in units of the distance between centres."""
    spacing = CONFIG.regions.volume_m3 ** (1 / 3) * (1 - CONFIG.regions.overlap)
    return spacing * np.array([x, y, z])


def predicted(region: Region, points: np.ndarray) -> np.ndarray:
    inputs = region.to_region(torch.from_numpy(points).float())
    return region.field.predict(inputs.contiguous().numpy())


def test_inside_its_own_part_the_first_region_is_alone(atlas):
    change = atlas.update(at(0.3))
    assert not change.created
    assert not change.working_changed
    assert list(atlas.regions) == [(0, 0, 0)]
    assert atlas.active == [atlas.working]


def test_entering_an_intersection_creates_the_neighbour_for_training(atlas):
    change = atlas.update(at(0.45))
    assert change.created == ((1, 0, 0),)
    assert not change.working_changed
    assert atlas.working.index == (0, 0, 0)
    assert [region.index for region in atlas.training] == [(1, 0, 0)]


def test_a_new_region_continues_the_map_exactly(atlas):
    atlas.update(at(0.45, 0.45))
    assert len(atlas.regions) == 4
    points = np.random.default_rng(0).uniform(-1.0, 2.5, (300, 3))
    inherited = [predicted(region, points) for region in atlas.regions.values()]
    for values in inherited[1:]:
        np.testing.assert_allclose(values, inherited[0], atol=2e-4)


def test_the_working_region_changes_past_the_middle_and_not_before(atlas):
    margin = np.array([CONFIG.regions.hysteresis_m, 0.0, 0.0])
    atlas.update(at(0.5) + margin * 0.8)
    assert atlas.working.index == (0, 0, 0)
    change = atlas.update(at(0.5) + margin * 1.2)
    assert change.working_changed
    assert atlas.working.index == (1, 0, 0)
    assert [region.index for region in atlas.training] == [(0, 0, 0)]
    # On the way back it takes the same margin on the other side.
    assert not atlas.update(at(0.5) - margin * 0.8).working_changed
    assert atlas.update(at(0.5) - margin * 1.2).working_changed


def test_a_region_that_is_left_rests_and_is_woken_on_return(atlas):
    atlas.update(at(0.45))
    atlas.update(at(1.0))
    assert atlas.active == [atlas.regions[(1, 0, 0)]]
    weights = atlas.regions[(0, 0, 0)].field.flat()
    change = atlas.update(at(0.55))
    assert change.woken == ((0, 0, 0),)
    assert not change.created
    np.testing.assert_array_equal(atlas.regions[(0, 0, 0)].field.flat(), weights)


def test_keyframes_go_to_every_active_region(atlas):
    atlas.update(at(0.45))
    number = add_keyframe(atlas, path(2)[1])
    for region in atlas.active:
        assert region.keyframes[-1] == number
    atlas.update(at(1.0))
    last = add_keyframe(atlas, path(3)[2])
    assert atlas.regions[(1, 0, 0)].keyframes[-1] == last
    assert atlas.regions[(0, 0, 0)].keyframes[-1] == number


def test_a_new_region_inherits_the_keyframes_that_see_it(atlas):
    # The keyframe looks along x, into the neighbour on that side, and away from the other.
    atlas.update(at(0.45))
    assert atlas.regions[(1, 0, 0)].keyframes == [0]
    assert atlas.regions[(1, 0, 0)].mask.observed_volume_m3 > 0.5
    atlas.update(at(-0.45))
    # Something must train a region, so that it is not without keyframes.
    assert atlas.regions[(-1, 0, 0)].keyframes


def test_a_jump_beyond_all_regions_creates_one_there(atlas):
    change = atlas.update(at(5.0, -3.0, 1.0))
    assert change.working_changed
    assert atlas.working.index == (5, -3, 1)
    assert atlas.training == []


def test_masks_are_rebuilt_from_the_refined_poses(atlas):
    before = atlas.working.mask.flags.copy()
    assert not atlas.rebuild_mask(atlas.working)
    np.testing.assert_array_equal(atlas.working.mask.flags, before)
    moved = atlas.keyframes.pose(0)
    moved[:3, 3] += [0.0, 0.5, 0.0]
    atlas.keyframes.set_pose(0, moved)
    assert atlas.rebuild_mask(atlas.working)
    assert not np.array_equal(atlas.working.mask.flags, before)


def test_region_coordinates_span_the_box(atlas):
    atlas.update(at(0.45))
    region = atlas.regions[(1, 0, 0)]
    half = 0.5 * region.side_m
    corners = (
        torch.tensor([[half, -half, half], [0.0, 0.0, 0.0]]) + torch.from_numpy(at(1.0)).float()
    )
    expected = torch.tensor([[1.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(region.to_region(corners), expected, atol=1e-5, rtol=0)
