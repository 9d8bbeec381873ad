"""Creating, inheriting, waking and switching regions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import NEAR_M, RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import exp

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


def far(atlas: RegionAtlas, position: np.ndarray) -> None:
    """Move and do what an update leaves to be done."""
    atlas.update(position)
    atlas.settle()


@pytest.fixture
def resting(atlas: RegionAtlas) -> RegionAtlas:
    """The same atlas with a disk to rest on."""
    scratch = ScratchFile()
    keyframes = KeyframeStore(512, torch.device("cpu"), scratch=scratch)
    atlas = RegionAtlas(CONFIG, np.zeros(3), keyframes, seed=0, scratch=scratch)
    add_keyframe(atlas, path(1)[0])
    return atlas


def asleep(atlas: RegionAtlas) -> list[tuple[int, int, int]]:
    return [index for index, region in atlas.regions.items() if region.at_rest]


def test_what_is_left_rests_on_disk_and_wakes_before_it_is_entered(resting):
    far(resting, at(0.45))
    assert asleep(resting) == []
    far(resting, at(1.0))
    weights = resting.regions[(0, 0, 0)].weights()
    assert asleep(resting) == [(0, 0, 0)]
    border = (0.5 * resting.grid.side_m + NEAR_M) / resting.grid.spacing_m
    far(resting, at(border + 0.02))
    assert asleep(resting) == [(0, 0, 0)]
    far(resting, at(border - 0.02))
    assert asleep(resting) == []
    assert resting.training == []
    np.testing.assert_array_equal(resting.regions[(0, 0, 0)].weights(), weights)


def test_a_camera_that_sways_at_a_border_wakes_and_rests_nothing(resting):
    far(resting, at(0.45))
    far(resting, at(0.9))
    inside, outside = at(0.615), at(0.64)
    far(resting, inside)
    field = resting.regions[(0, 0, 0)].field
    for _ in range(5):
        far(resting, outside)
        far(resting, inside)
    assert resting.regions[(0, 0, 0)].field is field


def test_regions_in_memory_do_not_grow_with_those_that_exist(resting):
    for step in np.arange(0.0, 12.0, 0.25):
        far(resting, at(step))
        assert len(resting.regions) - len(asleep(resting)) <= 2
    assert len(resting.regions) == 13


def test_rays_of_regions_at_rest_leave_memory_and_are_there_again_on_return(resting):
    far(resting, at(0.45))
    later = path(2)[1]
    later[:3, 3] = at(3.0)
    far(resting, at(3.0))
    new = add_keyframe(resting, later)
    far(resting, at(6.0))
    assert resting.keyframes.drawable([0, new]).tolist() == [new]
    far(resting, at(0.0))
    assert resting.keyframes.drawable(resting.working.keyframes).tolist() == [0]


def test_at_a_corner_eight_regions_are_active_and_the_nearest_works(resting):
    far(resting, at(0.47, 0.47, 0.47))
    assert len(resting.regions) == len(resting.active) == 8
    assert resting.working.index == (0, 0, 0)
    far(resting, at(0.56, 0.44, 0.56))
    assert resting.working.index == (1, 0, 1)
    assert len(resting.active) == 8
    # Back over one of the middles alone.
    far(resting, at(0.56, 0.44, 0.44))
    assert resting.working.index == (1, 0, 0)


def test_a_camera_on_the_middle_does_not_make_the_working_region_flip(resting):
    changes = 0
    sway = 0.8 * CONFIG.regions.hysteresis_m / resting.grid.spacing_m
    for number in range(20):
        change = resting.update(at(0.5 + sway * (-1) ** number, 0.5 - sway * (-1) ** number))
        changes += change.working_changed
    assert changes == 0


def with_regions(atlas: RegionAtlas, **changed: object) -> RegionAtlas:
    config = replace(CONFIG, regions=replace(CONFIG.regions, **changed))
    return RegionAtlas(config, np.zeros(3), atlas.keyframes, seed=0)


def test_a_new_region_can_begin_with_copied_weights_or_from_nothing(atlas):
    points = np.random.default_rng(0).uniform(-1.0, 2.5, (300, 3))
    parents, children = {}, {}
    for how in ("continued", "copied", "random"):
        other = with_regions(atlas, initialisation=how)
        other.working.keyframes = [0]
        other.working.field.load_flat(other.working.weights() * 0.9)
        other.update(at(0.45))
        parents[how], children[how] = other.regions[(0, 0, 0)], other.regions[(1, 0, 0)]
    np.testing.assert_array_equal(children["copied"].weights(), parents["copied"].weights())
    for how in ("copied", "random"):
        apart = predicted(children[how], points) - predicted(parents[how], points)
        assert np.abs(apart).max() > 0.05
    np.testing.assert_allclose(
        predicted(children["continued"], points), predicted(parents["continued"], points), atol=2e-4
    )


def test_a_new_region_goes_on_with_what_was_observed(atlas):
    atlas.update(at(0.45))
    parent, child = atlas.regions[(0, 0, 0)], atlas.regions[(1, 0, 0)]
    points = np.random.default_rng(0).uniform(-1.0, 2.5, (2000, 3))
    before = parent.mask.lookup(points - parent.T_map_region[:3, 3])
    after = child.mask.lookup(points - child.T_map_region[:3, 3])
    # Voxels do not lie in the same places: only their borders may differ.
    assert np.mean(before != after) < 0.1
    assert np.count_nonzero(after) > 50


def test_one_network_can_serve_everywhere(atlas):
    single = with_regions(atlas, single=True)
    for step in range(8):
        assert single.update(at(step, -step)).created == ()
    assert list(single.regions) == [(0, 0, 0)]


def test_a_keyframe_that_saw_a_region_at_rest_is_replayed_when_it_wakes(resting):
    far(resting, at(0.45))
    far(resting, at(1.2))
    back = path(1)[0]
    back[:3, :3] = back[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    back[:3, 3] = at(0.8)
    far(resting, back[:3, 3])
    number = add_keyframe(resting, back)
    assert number not in resting.regions[(0, 0, 0)].keyframes
    seen_before = resting.regions[(0, 0, 0)].observed().observed_volume_m3
    far(resting, at(0.55))
    # Not before it is known where the camera is in its map.
    assert number not in resting.regions[(0, 0, 0)].keyframes
    resting.regions[(0, 0, 0)].confirmed = True
    far(resting, at(0.55))
    assert number in resting.regions[(0, 0, 0)].keyframes
    # One view is marked a frame, and the working region has its own.
    resting.settle()
    assert resting.regions[(0, 0, 0)].mask.observed_volume_m3 > seen_before


def test_a_region_that_was_not_recognised_waits_until_the_map_beside_it_ends(resting):
    for step in (0.45, 1.2, 0.55, 0.45):
        far(resting, at(step))
    assert not resting.regions[(0, 0, 0)].confirmed
    # The camera has left the working region's box, but not what it has seen.
    far(resting, at(0.2))
    assert resting.working.index == (1, 0, 0)
    far(resting, at(-0.1))
    assert resting.working.index == (0, 0, 0)


def test_beside_a_region_that_was_not_recognised_a_new_one_takes_up_nothing_from_before(resting):
    earlier = path(1)[0]
    earlier[:3, 3] = at(0.55, 1.2)
    number = resting.keyframes.add(0, earlier, resting.keyframes.all_rays(0))
    for step in (0.45, 1.2, 0.55):
        far(resting, at(step))
    assert resting.doubtful == [resting.regions[(0, 0, 0)]]
    far(resting, at(0.55, 0.45))
    child = resting.regions[(1, 1, 0)]
    assert number not in child.keyframes
    resting.regions[(0, 0, 0)].confirmed = True
    far(resting, at(0.55, 0.45))
    assert number in child.keyframes


def test_a_lost_camera_looks_into_one_region_after_the_other_and_enters_its_own(resting):
    for x in (0.0, 1.0, 2.0, 3.0):
        resting.update(at(x))
        resting.settle()
    first, second = resting.nearest(at(0.1)), resting.nearest(at(1.1))
    assert (first.index, second.index) == ((0, 0, 0), (1, 0, 0))
    working = resting.working
    for region in (first, second):
        assert region.at_rest
        resting.look_into(region)
        assert not region.at_rest
    assert first.at_rest
    assert resting.working is working
    resting.enter(first)
    assert resting.working is first
    assert first.confirmed
    assert not first.at_rest
    # And that is where it works when the camera moves on.
    resting.update(at(0.1))
    assert resting.working is first


def test_keyframes_that_proved_wrong_are_trained_no_more(atlas):
    atlas.update(at(0.45))
    kept = [add_keyframe(atlas, path(1)[0]) for _ in range(2)]
    wrong = add_keyframe(atlas, path(1)[0])
    atlas.discard(wrong)
    for region in atlas.regions.values():
        assert wrong not in region.keyframes
        assert set(kept) <= set(region.keyframes)
    # A region that has nothing else keeps what it has.
    atlas.discard(0)
    assert all(region.keyframes for region in atlas.regions.values())


def test_a_region_that_was_recognised_takes_over_at_once(resting):
    for step in (0.45, 1.2, 0.55):
        far(resting, at(step))
    resting.regions[(0, 0, 0)].confirmed = True
    far(resting, at(0.4))
    assert resting.working.index == (0, 0, 0)


def test_a_region_that_was_moved_has_its_neighbours_beside_it(atlas):
    motion = exp(np.array([0.3, -0.1, 0.05, 0.02, -0.05, 0.3]))
    atlas.working.T_map_region = motion @ atlas.working.T_map_region

    def moved(point: np.ndarray) -> np.ndarray:
        return motion[:3, :3] @ point + motion[:3, 3]

    atlas.update(moved(at(0.36)))
    assert list(atlas.regions) == [(0, 0, 0)]
    atlas.update(moved(at(0.45)))
    assert list(atlas.regions) == [(0, 0, 0), (1, 0, 0)]
    child = atlas.regions[(1, 0, 0)]
    np.testing.assert_allclose(child.T_map_region[:3, 3], moved(at(1.0)), atol=1e-9)
    np.testing.assert_allclose(child.T_map_region[:3, :3], motion[:3, :3])
    points = np.random.default_rng(0).uniform(-1.0, 2.0, (200, 3))
    np.testing.assert_allclose(
        predicted(child, points), predicted(atlas.working, points), atol=3e-4
    )
    atlas.update(moved(at(0.6)))
    assert atlas.working is child
