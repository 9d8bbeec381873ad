"""The store of keyframes and their rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.textured_room import frame_at, path

from meslam_core.mapping.keyframes import KeyframeStore, Rays, rays_at
from meslam_core.se3 import exp

CPU = torch.device("cpu")


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
