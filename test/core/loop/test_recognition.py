"""Regions that are come back to after the path has drifted."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from data.textured_room import CAMERA, frame_at, path

from meslam_core.config import MeslamConfig
from meslam_core.loop.recognition import MANY_DOUBTS, THEN_EVERY, RegionRecogniser
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, exp, inverse, log
from meslam_core.tracking.pixels import choose_pixels

LARGE = CAMERA.scaled(2.0)
CONFIG = MeslamConfig.from_overrides(
    ["keyframes.rays=512", "field.backend=torch", "regions.mask_voxel_m=0.2"]
)
POSES = path(8, step_m=0.05, step_deg=1.5)
DRIFT = exp(np.array([0.15, -0.2, 0.1, 0.01, -0.02, 0.03]))


class Walk:
    """Keyframes along a path that is believed to drift away from the truth."""

    def __init__(self) -> None:
        scratch = ScratchFile()
        self.keyframes = KeyframeStore(512, torch.device("cpu"), scratch=scratch)
        self.atlas = RegionAtlas(CONFIG, POSES[0][:3, 3], self.keyframes, 0, scratch)
        self.linker = CovisibilityLinker(self.keyframes, CONFIG, scratch)
        self.recogniser = RegionRecogniser(self.atlas, self.linker)
        self._generator = np.random.default_rng(0)

    def add(self, true: Pose, believed: Pose, linked: bool = True) -> tuple:
        number = len(self.keyframes)
        frame = frame_at(true, number, LARGE)
        rays = rays_at(frame, *choose_pixels(frame.depth_m > 0, 512, self._generator))
        self.keyframes.add(frame.stamp_ns, believed, rays)
        if linked and number:
            previous = inverse(self.keyframes.pose(number - 1)) @ believed
            self.keyframes.add_link(number - 1, number, previous)
        self.linker.keep(number, frame)
        return number, frame.camera, rays

    def ask(self, region: Region, keyframe: tuple) -> None:
        for _ in self.recogniser.ask(region, *keyframe):
            pass


@pytest.fixture
def returned() -> tuple[Walk, tuple]:
    """A walk that is back at its start, believed elsewhere; the first region has just woken."""
    walk = Walk()
    away = [p @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(100.0), 0.0])) for p in POSES]
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    for share, pose in zip(np.linspace(0.0, 1.0, len(away)), away, strict=True):
        walk.add(pose, exp(share * log(DRIFT)) @ pose)
    back = POSES[3] @ exp(np.array([0.03, 0.02, 0.0, 0.0, 0.02, 0.0]))
    latest = walk.add(back, DRIFT @ back)
    walk.atlas.working.confirmed, walk.atlas.working.known_until = False, len(POSES)
    return walk, (latest, back)


def test_the_path_is_corrected_by_what_a_region_recognises(returned):
    walk, (latest, back) = returned
    region, before = walk.atlas.working, walk.keyframes.pose(10)
    beside = inverse(walk.keyframes.pose(1)) @ region.T_map_region
    weights = region.weights()
    walk.ask(region, latest)
    assert region.confirmed
    assert walk.recogniser.corrections == 1
    found = log(inverse(back) @ walk.keyframes.pose(latest[0]))
    assert np.linalg.norm(found[:3]) < 0.02
    assert np.linalg.norm(found[3:]) < 0.01
    assert not np.allclose(walk.keyframes.pose(10), before, atol=1e-3)
    # The region goes with its keyframes, and no network is trained for it.
    kept = inverse(walk.keyframes.pose(1)) @ region.T_map_region
    np.testing.assert_allclose(kept, beside, atol=0.02)
    np.testing.assert_array_equal(region.weights(), weights)


def test_a_region_that_lies_where_it_is_believed_is_confirmed_and_nothing_moves():
    walk = Walk()
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    latest = walk.add(POSES[2], POSES[2])
    poses = walk.keyframes.poses()
    walk.atlas.working.confirmed, walk.atlas.working.known_until = False, len(POSES)
    walk.ask(walk.atlas.working, latest)
    assert walk.atlas.working.confirmed
    assert walk.recogniser.corrections == 0
    np.testing.assert_array_equal(walk.keyframes.poses(), poses)


def test_a_view_that_a_region_does_not_know_moves_nothing_and_is_asked_about_less_and_less(
    monkeypatch,
):
    walk, asked = Walk(), []
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    region = walk.atlas.working
    region.confirmed, region.known_until = False, len(POSES)
    away = POSES[0] @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(100.0), 0.0]))
    # Believed to see what the region's keyframes saw.
    latest = walk.add(away, POSES[2], linked=False)
    recognise = walk.linker.recognise

    def counted(*arguments):
        asked.append(region.doubts)
        return recognise(*arguments)

    monkeypatch.setattr(walk.linker, "recognise", counted)
    for _ in range(MANY_DOUBTS + THEN_EVERY):
        walk.ask(region, latest)
    assert not region.confirmed
    assert walk.recogniser.corrections == 0
    assert asked == [*range(MANY_DOUBTS), MANY_DOUBTS + THEN_EVERY - 1]


def test_a_region_whose_views_lie_elsewhere_is_asked_until_the_camera_comes_to_them():
    walk = Walk()
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    region = walk.atlas.working
    region.confirmed, region.known_until = False, len(POSES)
    away = POSES[0] @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(180.0), 0.0]))
    walk.ask(region, walk.add(away, away, linked=False))
    assert not region.confirmed
    assert region.doubts == 0


@pytest.mark.parametrize("turn_deg", [0.0, 24.0])
def test_a_view_that_shares_little_with_those_of_a_region_is_recognised(turn_deg):
    walk = Walk()
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    region = walk.atlas.working
    region.confirmed, region.known_until = False, len(POSES)
    back = POSES[0] @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(-turn_deg), 0.0]))
    latest = walk.add(back, DRIFT @ back, linked=False)
    walk.ask(region, latest)
    assert region.confirmed
    assert np.linalg.norm(log(inverse(back) @ walk.keyframes.pose(latest[0]))[:3]) < 0.02


@pytest.mark.parametrize(
    ("off_m", "recognised", "confirmed"),
    [(0.0, False, True), (0.04, False, False), (0.04, True, True), (0.1, True, False)],
)
def test_an_old_keyframes_image_tells_whether_a_region_is_where_it_is_believed(
    off_m, recognised, confirmed
):
    """A region that was recognised before is where it is: the path is not corrected again."""
    walk = Walk()
    for pose in POSES:
        walk.atlas.add_keyframe(walk.add(pose, pose)[0])
    region = walk.atlas.working
    region.confirmed, region.known_until = False, len(POSES)
    region.recognised = recognised
    walk.atlas.settle()
    back = POSES[2] @ exp(np.array([0.03, 0.0, 0.02, 0.0, 0.02, 0.0]))
    believed = exp(np.array([off_m, 0.0, 0.0, 0.0, 0.0, 0.0])) @ back
    assert walk.recogniser.confirm(2, frame_at(back, 99, LARGE), believed) is confirmed
    assert region.confirmed is confirmed
    assert region.recognised is (recognised or confirmed)
    assert len(walk.keyframes) == len(POSES)
