"""Registrations of new keyframes: all at once, or spread over the frames while those wait."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from data.textured_room import CAMERA, frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.mapping import keyframe_registration
from meslam_core.mapping.keyframe_registration import KEYFRAMES_BEHIND, KeyframeRegistration
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.scratch import ScratchFile
from meslam_core.tracking.pixels import choose_pixels

CONFIG = MeslamConfig.from_overrides(
    ["keyframes.rays=512", "keyframes.links=3", "field.backend=torch", "regions.mask_voxel_m=0.2"]
)


class Arriving:
    """Keyframes from nearly one place, one a frame."""

    def __init__(self, frames_wait: Callable[[], bool]) -> None:
        scratch = ScratchFile()
        self.keyframes = KeyframeStore(512, torch.device("cpu"), scratch=scratch)
        self.atlas = RegionAtlas(CONFIG, path(1)[0][:3, 3], self.keyframes, 0, scratch)
        self.registration = KeyframeRegistration(CONFIG, self.atlas, scratch, frames_wait)
        self._generator = np.random.default_rng(0)

    def add(self, count: int) -> None:
        for pose in path(count, step_m=0.01, step_deg=0.3):
            number = len(self.keyframes)
            frame = frame_at(pose, number, CAMERA.scaled(2.0))
            rays = rays_at(frame, *choose_pixels(frame.depth_m > 0, 512, self._generator))
            self.keyframes.add(frame.stamp_ns, pose, rays)
            self.registration.add((number, frame, rays))
            self.registration.proceed()

    @property
    def links(self) -> list[tuple[int, int]]:
        block = self.keyframes.links.all()
        return [(int(first), int(second)) for first, second in block.ends]

    @property
    def linked(self) -> list[int]:
        return [second for _, second in self.links]


@pytest.fixture(scope="module")
def at_once() -> list[tuple[int, int]]:
    arriving = Arriving(lambda: False)
    arriving.add(5)
    return arriving.links


def test_a_keyframe_has_its_links_before_the_next_frame(at_once):
    arriving = Arriving(lambda: False)
    arriving.add(4)
    assert arriving.linked.count(3) == 3


def test_while_frames_wait_one_registration_is_made_a_frame(at_once):
    arriving = Arriving(lambda: True)
    arriving.add(5)
    # The first keyframe has nobody to be registered with.
    assert len(arriving.linked) == 4
    assert arriving.linked == sorted(arriving.linked)


def test_what_was_put_off_is_made_up_for(at_once):
    waiting = True
    arriving = Arriving(lambda: waiting)
    arriving.add(5)
    waiting = False
    motion = arriving.registration.proceed()
    assert arriving.links == at_once
    np.testing.assert_array_equal(motion, np.eye(4))


def test_while_frames_wait_a_keyframe_is_not_registered_with_many(monkeypatch):
    monkeypatch.setattr(keyframe_registration, "LEAST_ATTEMPTS", 2)
    arriving = Arriving(lambda: True)
    arriving.add(5)
    for _ in range(20):
        arriving.registration.proceed()
    assert [arriving.linked.count(number) for number in range(5)] == [0, 1, 2, 2, 2]


def test_only_so_many_keyframes_are_behind_with_their_registrations():
    waiting = True
    arriving = Arriving(lambda: waiting)
    arriving.add(3 * KEYFRAMES_BEHIND)
    waiting = False
    arriving.registration.proceed()
    newest = 3 * KEYFRAMES_BEHIND - 1
    assert arriving.linked.count(newest) == 3
    assert len(arriving.linked) < 3 * newest - 3


def test_regions_in_doubt_are_asked_in_turn(monkeypatch):
    arriving = Arriving(lambda: False)
    registration = arriving.registration
    spacing = arriving.atlas.grid.spacing_m
    for steps in (0.45, 1.0, 1.45):
        arriving.atlas.update(np.array([steps * spacing, 0.0, 0.0]))
        arriving.atlas.settle()
    doubtful = list(arriving.atlas.regions.values())
    for region in doubtful:
        region.confirmed = False
    asked: list[tuple[int, int, int]] = []

    def ask(region, number, camera, rays):
        asked.append(region.index)
        return iter(())

    monkeypatch.setattr(registration.recogniser, "ask", ask)
    arriving.add(4)
    awake = [region.index for region in arriving.atlas.doubtful]
    assert len(awake) == 2
    assert asked == awake + awake


def test_where_the_camera_is_comes_before_links(monkeypatch):
    arriving = Arriving(lambda: True)
    arriving.add(4)
    arriving.atlas.working.confirmed = False
    arriving.atlas.settle()
    monkeypatch.setattr(
        arriving.registration.recogniser, "ask", lambda *_: iter([None, None, None])
    )
    before = len(arriving.linked)
    arriving.add(1)
    for _ in range(2):
        arriving.registration.proceed()
    assert len(arriving.linked) == before
    arriving.registration.proceed()
    assert len(arriving.linked) > before
