"""The store of keyframes and their rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path

from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import LEAST_RAYS, KeyframeStore, Rays, rays_at
from meslam_core.mapping.ray_storage import CHUNK_SHARE
from meslam_core.se3 import exp
from meslam_core.tracking.pixels import trusted_pixels

CPU = torch.device("cpu")
RAYS, BUDGET = 1024, 600 * 1024


def numbered_rays(count: int, number: int) -> Rays:
    """Rays that can be told apart."""
    directions = torch.nn.functional.normalize(
        torch.arange(1.0, 3 * count + 1).reshape(count, 3) + number, dim=1
    )
    colors = torch.arange(count)[:, None].expand(count, 3) / 255.0
    return Rays(directions, torch.arange(count) + 100.0 * number, colors)


def test_rays_through_pixels_end_where_the_depth_image_says():
    pose = path(2)[1]
    frame = frame_at(pose)
    rows, columns = np.array([3, 60, 119]), np.array([2, 80, 159])
    rays = rays_at(frame, rows, columns)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(3))
    ends = (rays.directions * rays.distances_m[:, None]).numpy()
    np.testing.assert_allclose(
        ends, frame.camera.back_project(frame.depth_m)[rows, columns], atol=1e-5
    )
    np.testing.assert_allclose(rays.colors.numpy() * 255, frame.color[rows, columns], atol=1e-3)


def test_the_store_grows_and_keeps_what_it_holds():
    store = KeyframeStore(20, CPU)
    poses = [exp(0.1 * number * np.arange(6.0)) for number in range(70)]
    for number, pose in enumerate(poses):
        assert store.add(1000 * number, pose, numbered_rays(20, number)) == number
    assert len(store) == 70
    assert store.stamps_ns == [1000 * number for number in range(70)]
    for number in (0, 15, 16, 33, 69):
        np.testing.assert_allclose(store.pose(number), poses[number], atol=1e-5)
        rays, expected = store.all_rays(number), numbered_rays(20, number)
        torch.testing.assert_close(rays.directions, expected.directions)
        torch.testing.assert_close(rays.distances_m, expected.distances_m)
        torch.testing.assert_close(rays.colors, expected.colors, atol=1e-6, rtol=0)


def test_a_batch_gathers_rays_of_many_keyframes():
    store = KeyframeStore(20, CPU)
    for number in range(5):
        store.add(number, np.eye(4), numbered_rays(20, number))
    rays = store.rays(torch.tensor([4, 0, 2]), torch.tensor([7, 19, 0]))
    torch.testing.assert_close(rays.distances_m, torch.tensor([407.0, 19.0, 200.0]))


def test_arrays_hold_the_same_rays_for_indices_of_any_shape():
    store = KeyframeStore(20, CPU)
    for number in range(5):
        store.add(number, np.eye(4), numbered_rays(20, number))
    keyframes, slots = np.array([[4, 0], [2, 2]]), np.array([[7, 19], [0, 3]])
    directions, distances, colors = store.ray_arrays(keyframes, slots)
    rays = store.rays(torch.from_numpy(keyframes), torch.from_numpy(slots))
    np.testing.assert_array_equal(directions, rays.directions)
    np.testing.assert_array_equal(distances, [[407.0, 19.0], [200.0, 203.0]])
    np.testing.assert_array_equal(colors[0], [[7, 7, 7], [19, 19, 19]])


def test_a_keyframe_with_few_rays_repeats_them():
    store = KeyframeStore(20, CPU)
    store.add(0, np.eye(4), numbered_rays(6, 0))
    distances = store.all_rays(0).distances_m
    assert distances.shape == (20,)
    assert sorted(set(distances.tolist())) == list(range(6))


def test_a_replaced_pose_changes_no_other():
    store = KeyframeStore(4, CPU)
    for number in range(3):
        store.add(number, np.eye(4), numbered_rays(4, number))
    moved = exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    store.set_pose(1, moved)
    np.testing.assert_allclose(store.pose(1), moved, atol=1e-6)
    np.testing.assert_array_equal(store.pose(0), np.eye(4))
    np.testing.assert_array_equal(store.pose(2), np.eye(4))


def test_a_new_keyframe_is_sampled_as_often_as_the_worst_known():
    store = KeyframeStore(4, CPU)
    for number in range(3):
        store.add(number, np.eye(4), numbered_rays(4, number))
    store.losses[1] = 7.0
    newest = store.add(3, np.eye(4), numbered_rays(4, 3))
    assert store.losses[newest].item() == 7.0


def test_a_keyframe_is_linked_to_its_predecessor_and_to_any_other():
    store = KeyframeStore(4, CPU)
    for number in range(3):
        store.add(number, np.eye(4), numbered_rays(4, number), np.eye(4) if number == 2 else None)
    assert len(store.links) == 1
    store.add_link(0, 2, np.eye(4), 0.5)
    assert len(store.links) == 2


@pytest.mark.parametrize(
    ("link", "error"),
    [
        ((0, 3, np.eye(4)), IndexError),
        ((-1, 1, np.eye(4)), IndexError),
        ((1, 1, np.eye(4)), ValueError),
        ((0, 1, np.full((4, 4), np.nan)), ValueError),
        ((0, 1, np.eye(4), -1.0), ValueError),
        ((0, 1, np.eye(4), float("inf")), ValueError),
    ],
)
def test_links_that_mean_nothing_are_refused(link, error):
    store = KeyframeStore(4, CPU)
    for number in range(3):
        store.add(number, np.eye(4), numbered_rays(4, number))
    with pytest.raises(error, match="link"):
        store.add_link(*link)
    assert len(store.links) == 0


def image_rays(number: int, count: int = RAYS) -> Rays:
    """Rays in raster order, each of which tells its keyframe and its place in the image."""
    place = torch.arange(count, dtype=torch.float32)
    directions = torch.stack([place, -place, torch.full((count,), float(number))], dim=1)
    return Rays(directions, place + count * number, (place % 256)[:, None].expand(-1, 3) / 255.0)


def filled_store(keyframes: int, seed: int = 0) -> KeyframeStore:
    """A store that was filled beyond its budget."""
    store = KeyframeStore(RAYS, CPU, BUDGET, seed)
    for number in range(keyframes):
        store.add(number, exp(0.001 * number * np.arange(6.0)), image_rays(number))
    return store


def stored_bytes(store: KeyframeStore) -> int:
    """Of all rays, used or not."""
    return 19 * store.storage.allocated


def assert_spread(places: np.ndarray, count: int = RAYS) -> None:
    """One place of each of as many equal stretches of the image as there are places."""
    stretch = count // len(places)
    np.testing.assert_array_equal(places // stretch, np.arange(len(places)))


def test_rays_keep_their_budget_however_many_keyframes_there_are():
    store = KeyframeStore(RAYS, CPU, BUDGET)
    numbers = []
    for number in range(2000):
        store.add(number, np.eye(4), image_rays(number))
        numbers.append(store.rays_per_keyframe)
        assert len(store) * store.rays_per_keyframe <= BUDGET
        assert stored_bytes(store) <= 19 * BUDGET
    assert numbers == [1024] * 600 + [512] * 600 + [256] * 800


def test_the_rays_that_remain_are_the_keyframes_own_and_cover_its_image():
    store = filled_store(1300)
    assert store.rays_per_keyframe == 256
    taken = []
    for number in (0, 1, 2, 599, 600, 1199, 1200, 1299):
        rays, original = store.all_rays(number), image_rays(number)
        places = rays.distances_m.long() - RAYS * number
        assert_spread(places.numpy())
        torch.testing.assert_close(rays.directions, original.directions[places])
        torch.testing.assert_close(rays.colors, original.colors[places], atol=1e-6, rtol=0)
        taken.append(places % 4)
    # Which of its neighbours remains is left to chance.
    share = torch.bincount(torch.cat(taken), minlength=4) / (256 * len(taken))
    torch.testing.assert_close(share, torch.full((4,), 0.25), atol=0.04, rtol=0)
    assert not torch.equal(taken[0], taken[1])


def test_batches_find_the_rays_that_remain():
    store = filled_store(700)
    keyframes, slots = np.array([[699, 0], [3, 600]]), np.array([[511, 0], [7, 256]])
    directions, distances, colors = store.ray_arrays(keyframes, slots)
    rays = store.rays(torch.from_numpy(keyframes), torch.from_numpy(slots))
    np.testing.assert_array_equal(distances // RAYS, keyframes)
    np.testing.assert_array_equal(directions[..., 2], keyframes)
    np.testing.assert_array_equal(colors[..., 0], distances % 256)
    np.testing.assert_array_equal(rays.directions, directions)
    np.testing.assert_array_equal(rays.distances_m, distances)


def test_fewer_rays_leave_poses_losses_and_links_alone():
    store = KeyframeStore(RAYS, CPU, 20 * RAYS)
    poses = [exp(0.1 * number * np.arange(6.0)) for number in range(21)]
    for number in range(20):
        store.add(number, poses[number], image_rays(number), np.eye(4) if number else None)
    store.loss_array()[:] = np.arange(20)
    store.add(20, poses[20], image_rays(20))
    assert store.rays_per_keyframe == RAYS // 2
    for number in range(21):
        np.testing.assert_allclose(store.pose(number), poses[number], atol=1e-5)
    np.testing.assert_array_equal(store.loss_array(), [*range(20), 19])
    assert store.stamps_ns == list(range(21))
    assert len(store.links) == 19


def test_no_keyframe_is_thinned_beyond_use():
    budget = 100 * LEAST_RAYS
    store = KeyframeStore(RAYS, CPU, budget)
    for number in range(400):
        store.add(number, np.eye(4), image_rays(number))
        needed = max(budget, len(store) * LEAST_RAYS)
        assert stored_bytes(store) <= 19 * (needed + CHUNK_SHARE * budget + LEAST_RAYS)
    assert store.rays_per_keyframe == LEAST_RAYS
    for number in (0, 99, 100, 399):
        assert_spread((store.all_rays(number).distances_m - RAYS * number).numpy().astype(int))


def test_a_budget_below_one_keyframe_is_kept_too():
    store = KeyframeStore(1000, CPU, 600)
    store.add(0, np.eye(4), image_rays(0, 1000))
    assert store.rays_per_keyframe == 500
    assert_spread(store.all_rays(0).distances_m.numpy().astype(int), 1000)


@pytest.mark.parametrize("rays", [300, 700, 5000])
def test_a_keyframe_may_come_with_any_number_of_rays(rays):
    store = filled_store(601)
    number = store.add(601, np.eye(4), image_rays(0, rays))
    places = store.all_rays(number).distances_m.numpy()
    assert places.shape == (512,)
    assert len(set(places.tolist())) == min(rays, 512)
    counts = np.histogram(places, bins=4, range=(0, rays))[0]
    assert counts.min() >= 60


def test_the_seed_decides_which_rays_remain():
    first, again, other = (filled_store(601, seed).all_rays(5).distances_m for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_training_goes_on_with_fewer_rays(build_room):
    room = build_room(200, ("keyframes.rays=4096",))
    small = KeyframeStore(4096, CPU, 5 * 4096)
    for number in range(len(room.keyframes)):
        small.add(number, room.keyframes.pose(number), room.keyframes.all_rays(number))
    optimizer = JointOptimizer(small, room.config.mapping, seed=0)
    before = optimizer.train(room.region, 60, refine_poses=False).total
    frame, pose = room.frame(20), room.poses[20]
    rows, columns = np.nonzero(trusted_pixels(frame.depth_m, room.config.sensor))
    room.region.keyframes.append(small.add(5, pose, rays_at(frame, rows, columns)))
    assert small.rays_per_keyframe == 2048
    losses = optimizer.train(room.region, 200)
    assert losses.steps == 200
    assert losses.total < 1.05 * before
    for number, true in zip(room.mapped, room.poses[::10], strict=True):
        offset = small.pose(room.mapped.index(number))[:3, 3] - true[:3, 3]
        assert np.linalg.norm(offset) < 0.01
