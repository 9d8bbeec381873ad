"""Rays in memory and on disk."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meslam_core.mapping.ray_storage import LEAST_RAYS, Rays, RayStorage
from meslam_core.scratch import ScratchFile

CPU = torch.device("cpu")
RAYS = 1024


def image_rays(number: int) -> Rays:
    """Rays that tell their keyframe and their place in the image."""
    place = torch.arange(RAYS, dtype=torch.float32)
    directions = torch.stack([place, -place, torch.full((RAYS,), float(number))], dim=1)
    colors = (place % 256)[:, None].expand(-1, 3) / 255.0
    return Rays(directions, place + RAYS * number, colors)


def filled(keyframes: int, budget: int = 1000 * RAYS, seed: int = 0) -> RayStorage:
    storage = RayStorage(RAYS, CPU, budget, seed, ScratchFile())
    for number in range(keyframes):
        assert storage.add(image_rays(number)) == number
    return storage


def in_memory(storage: RayStorage, keyframes: int) -> list[int]:
    return np.flatnonzero(storage.in_memory(np.arange(keyframes))).tolist()


def assert_same(rays: Rays, number: int) -> None:
    expected = image_rays(number)
    assert torch.equal(rays.directions, expected.directions)
    assert torch.equal(rays.distances_m, expected.distances_m)
    torch.testing.assert_close(rays.colors, expected.colors, atol=1e-6, rtol=0)


def test_what_nobody_needs_leaves_memory_and_comes_back_as_it_was():
    storage = filled(20)
    storage.hold([3, 7], at_most=100)
    assert in_memory(storage, 20) == [3, 7]
    for number in (0, 3, 19):
        assert_same(storage.read(number), number)
    storage.hold([0, 19], at_most=100)
    assert in_memory(storage, 20) == [0, 19]
    for number in (0, 19):
        assert_same(storage.read(number), number)


def test_memory_that_was_freed_is_used_again():
    storage = filled(20)
    allocated = storage.allocated
    for start in range(0, 400, 20):
        storage.hold(range(start, start + 20), at_most=100)
        for number in range(start + 20, start + 40):
            storage.add(image_rays(number))
        storage.hold(range(start + 20, start + 40), at_most=100)
    assert storage.allocated == allocated
    assert_same(storage.read(5), 5)
    assert_same(storage.read(405), 405)


def test_batches_find_the_rays_of_those_that_came_back():
    storage = filled(9)
    storage.hold([1, 8], at_most=9)
    storage.hold([8, 2, 1, 5], at_most=9)
    keyframes, slots = np.array([[5, 8], [1, 2]]), np.array([[3, 1023], [0, 256]])
    directions, distances, colors = storage.arrays(storage.rows(keyframes, slots))
    np.testing.assert_array_equal(distances, RAYS * keyframes + slots)
    np.testing.assert_array_equal(directions[..., 2], keyframes)
    np.testing.assert_array_equal(colors[..., 0], slots % 256)


def test_only_a_few_are_read_at_a_time_the_most_important_first():
    storage = filled(10)
    storage.hold([0], at_most=10)
    storage.hold([0, 4, 2, 6, 9], at_most=2)
    assert in_memory(storage, 10) == [0, 6, 9]
    storage.hold([0, 4, 2, 6, 9], at_most=2)
    assert in_memory(storage, 10) == [0, 2, 4, 6, 9]


def test_the_budget_thins_what_is_in_memory_alone():
    storage = filled(40, budget=10 * RAYS)
    assert storage.per_keyframe == LEAST_RAYS
    storage.hold([1, 2], at_most=10)
    # With few keyframes there is room for all their rays again.
    assert storage.per_keyframe == RAYS
    for number in (1, 2, 17):
        assert_same(storage.read(number), number)


def test_denser_rays_come_back_only_where_they_leave_room_for_more_keyframes():
    storage = filled(21, budget=20 * RAYS)
    assert storage.per_keyframe == RAYS // 2
    storage.hold(range(16), at_most=0)
    assert storage.per_keyframe == RAYS // 2
    storage.hold(range(15), at_most=0)
    assert storage.per_keyframe == RAYS
    for number in range(21, 25):
        storage.add(image_rays(number))
    assert storage.per_keyframe == RAYS


def test_without_a_disk_everything_stays():
    storage = RayStorage(RAYS, CPU, 100 * RAYS, 0, None)
    for number in range(5):
        storage.add(image_rays(number))
    storage.hold([], at_most=1)
    assert in_memory(storage, 5) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("count", [1, 300, RAYS, 3000])
def test_any_number_of_rays_can_rest(count):
    storage = RayStorage(RAYS, CPU, 100 * RAYS, 0, ScratchFile())
    distances = torch.arange(count, dtype=torch.float32)
    storage.add(Rays(torch.zeros(count, 3), distances, torch.zeros(count, 3)))
    storage.hold([], at_most=1)
    found = storage.read(0).distances_m
    assert len(found) == RAYS
    assert len(found.unique()) == min(count, RAYS)
    assert float(found.max()) >= count - 1 - count // RAYS
