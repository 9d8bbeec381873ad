"""Joint optimisation of a region's network and its keyframes' poses."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from data.textured_room import path

from meslam_core.field.model import TorchField
from meslam_core.mapping import joint_optimizer
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframes import Rays, rays_at
from meslam_core.se3 import exp, inverse, log
from meslam_core.tracking.pixels import trusted_pixels

ERROR = exp(np.array([0.015, -0.02, 0.01, 0.01, -0.008, 0.012]))
"""A keyframe pose that is wrong by 2.7 cm and 1 degree."""


@pytest.fixture
def room(build_room):
    """A briefly trained map that a test may change."""
    return build_room(200)


def pose_error(room, keyframe: int) -> tuple[float, float]:
    """Distance [m] and angle [rad] between a keyframe's pose and the truth."""
    true = room.poses[room.mapped[keyframe]]
    twist = log(inverse(true) @ room.keyframes.pose(keyframe))
    return float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))


def test_training_lowers_the_loss(build_room):
    room = build_room(0)
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    first = optimizer.train(room.region, 10)
    optimizer.train(room.region, 150)
    last = optimizer.train(room.region, 10)
    assert last.total < 0.4 * first.total
    assert last.total == pytest.approx(last.distance + last.depth + last.color)


def test_a_wrong_keyframe_pose_is_recovered(room):
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    room.keyframes.set_pose(2, ERROR @ room.poses[room.mapped[2]])
    before = pose_error(room, 2)
    assert before[0] > 0.02
    optimizer.train(room.region, 250)
    after = pose_error(room, 2)
    assert after[0] < 0.007
    assert after[1] < 0.006
    # The others hold the map in place.
    for keyframe in (1, 3):
        assert pose_error(room, keyframe)[0] < 0.007


def test_the_first_keyframe_never_moves(room):
    before = room.keyframes.pose(0)
    JointOptimizer(room.keyframes, room.config.mapping).train(room.region, 20)
    np.testing.assert_array_equal(room.keyframes.pose(0), before)


def test_poses_rest_when_they_are_not_to_be_refined(room):
    before = room.keyframes.rotations.clone(), room.keyframes.translations.clone()
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    optimizer.train(room.region, 20, refine_poses=False)
    torch.testing.assert_close(room.keyframes.rotations, before[0], atol=0, rtol=0)
    torch.testing.assert_close(room.keyframes.translations, before[1], atol=0, rtol=0)


def test_refined_rotations_stay_rotations(room):
    JointOptimizer(room.keyframes, room.config.mapping).train(room.region, 100)
    rotations = room.keyframes.rotations.double()
    gram = rotations @ rotations.transpose(1, 2)
    torch.testing.assert_close(gram, torch.eye(3).double().expand(5, 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotations) > 0).all()


def test_the_current_frame_is_learnt_too(build_room):
    room = build_room(0)
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    pose = path(1)[0].copy()
    # A wall half a metre in front of the camera, which no keyframe has seen.
    generator = torch.Generator().manual_seed(0)
    aside = torch.rand(500, 2, generator=generator) * 0.5 - 0.25
    ends = torch.cat([aside, torch.full((500, 1), -0.5)], dim=1)
    lengths = ends.norm(dim=1)
    wall = Rays(ends / lengths[:, None], lengths, torch.full((500, 3), 0.5))
    optimizer.train(room.region, 150, wall, pose, refine_poses=False)
    on_wall = (
        ends @ torch.from_numpy(pose[:3, :3]).float().T + torch.from_numpy(pose[:3, 3])
    ).float()
    before_wall = on_wall - 0.08 * (wall.directions @ torch.from_numpy(pose[:3, :3]).float().T)
    values = [
        room.region.field.predict(room.region.to_region(points).numpy())[:, 0]
        for points in (on_wall, before_wall)
    ]
    assert np.median(values[0]) > -0.1
    assert np.median(values[1]) < -0.3


def test_torch_and_the_kernel_learn_alike(build_room):
    """The same steps in two implementations, with other random samples along the rays."""
    losses = []
    for backend in ("kernel", "torch"):
        room = build_room(0, (f"field.backend={backend}",))
        optimizer = JointOptimizer(room.keyframes, room.config.mapping)
        pose = room.poses[5]
        frame = room.frame(5)
        rows, columns = np.nonzero(trusted_pixels(frame.depth_m, room.config.sensor))
        current = rays_at(frame, rows[::7], columns[::7])
        optimizer.train(room.region, 60, current, pose)
        losses.append(optimizer.train(room.region, 20, current, pose))
    assert losses[0].total == pytest.approx(losses[1].total, rel=0.15)
    assert losses[0].color == pytest.approx(losses[1].color, rel=0.15)


def test_torch_and_the_kernel_pull_a_wrong_pose_alike(room):
    room.keyframes.set_pose(2, ERROR @ room.poses[room.mapped[2]])
    reference = TorchField(room.config.field)
    reference.load_flat(room.region.field.flat())
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    draws = optimizer._draw(room.region, 6, None)
    rotations, translations = room.keyframes.pose_arrays()
    sums = []
    for network in (room.region.field, reference):
        region = room.region.viewed(network, room.region.mask)
        batches = optimizer._batches(region, draws, None, refine_poses=True)
        steps = [batches.train(step, rotations, translations) for step in range(6)]
        sums.append((np.sum([s[0] for s in steps], axis=0), np.sum([s[1] for s in steps], axis=0)))
    np.testing.assert_allclose(sums[0][0].mean(axis=0), sums[1][0].mean(axis=0), rtol=0.15)
    one, other = sums[0][1][2], sums[1][1][2]
    assert one @ other > 0.9 * np.linalg.norm(one) * np.linalg.norm(other)


def test_keyframes_of_other_regions_stand_still(room):
    room.region.keyframes.remove(1)
    room.region.keyframes.remove(3)
    for number in range(4):
        room.keyframes.add_link(number, number + 1, ERROR)
    before = [room.keyframes.pose(number) for number in range(5)]
    JointOptimizer(room.keyframes, room.config.mapping).train(room.region, 10)
    for number in (0, 1, 3):
        np.testing.assert_array_equal(room.keyframes.pose(number), before[number])
    for number in (2, 4):
        assert np.abs(room.keyframes.pose(number) - before[number]).max() > 1e-4


def test_what_fits_badly_is_remembered(room):
    room.keyframes.set_pose(2, ERROR @ room.poses[room.mapped[2]])
    room.keyframes.losses[:] = 1.0
    JointOptimizer(room.keyframes, room.config.mapping).train(
        room.region, 30, refine_poses=False, rate_factor=1e-6
    )
    losses = room.keyframes.losses
    assert losses.argmax().item() == 2
    assert (losses < 0.8).all()


def test_a_portion_of_steps_or_several_learn_alike(build_room, monkeypatch):
    totals = []
    for portion in (64, 5):
        monkeypatch.setattr(joint_optimizer, "STEPS_AT_ONCE", portion)
        room = build_room(0)
        optimizer = JointOptimizer(room.keyframes, room.config.mapping)
        optimizer.train(room.region, 60)
        totals.append(optimizer.train(room.region, 17).total)
    assert totals[0] == pytest.approx(totals[1], rel=0.15)


def test_a_step_whose_gradient_is_not_finite_changes_nothing(room):
    optimizer = JointOptimizer(room.keyframes, room.config.mapping)
    field, poses = room.region.field.flat(), room.keyframes.translations.clone()
    broken = Rays(torch.full((10, 3), float("nan")), torch.ones(10), torch.ones(10, 3))
    optimizer.train(room.region, 2, broken, np.eye(4))
    np.testing.assert_array_equal(room.region.field.flat(), field)
    torch.testing.assert_close(room.keyframes.translations, poses, atol=0, rtol=0)


def test_a_loss_that_is_not_finite_is_not_remembered(room):
    broken = Rays(torch.ones(10, 3), torch.full((10,), float("nan")), torch.ones(10, 3))
    room.atlas.working.keyframes.append(room.keyframes.add(9, np.eye(4), broken))
    JointOptimizer(room.keyframes, room.config.mapping).train(room.region, 2)
    assert torch.isfinite(room.keyframes.losses).all()
    assert np.isfinite(room.region.field.flat()).all()


def test_the_seed_decides(build_room):
    def trained(seed: int) -> np.ndarray:
        room = build_room(0)
        JointOptimizer(room.keyframes, room.config.mapping, seed).train(room.region, 15)
        return room.region.field.flat()

    first = trained(1)
    np.testing.assert_array_equal(first, trained(1))
    assert not np.array_equal(first, trained(2))


def test_no_step_changes_nothing(room):
    before = copy.copy(room.region.field.flat())
    losses = JointOptimizer(room.keyframes, room.config.mapping).train(room.region, 0)
    assert losses.total == 0.0
    np.testing.assert_array_equal(room.region.field.flat(), before)
