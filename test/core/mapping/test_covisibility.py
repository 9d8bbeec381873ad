"""Keyframes that see the same are tied to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from data.textured_room import CAMERA, frame_at, path

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.mapping import covisibility
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframe_images import DEPTH_UNIT_M, KeyframeImage
from meslam_core.mapping.keyframes import KeyframeStore, rays_at
from meslam_core.odometry.registration import Registration
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, exp, inverse, log
from meslam_core.tracking.pixels import choose_pixels

LARGE = CAMERA.scaled(2.0)
START = path(1)[0]
AWAY = START @ exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(120.0), 0.0]))
RETURN = START @ exp(np.array([0.02, 0.01, 0.03, 0.01, 0.03, -0.02]))
# In the keyframe's own axes; 5 cm in all.
OFF_5_CM = exp(np.array([0.03, -0.04, 0.0, 0.0, 0.0, 0.0]))


def plain_frame(depth_m: np.ndarray, camera: PinholeCamera) -> RgbdFrame:
    color = np.full((*depth_m.shape, 3), 100, np.uint8)
    return RgbdFrame(7, color, depth_m.astype(np.float32), camera)


class Mapper:
    """A store and a linker that are given exact views."""

    def __init__(self, *overrides: str) -> None:
        config = MeslamConfig.from_overrides(["keyframes.rays=512", *overrides])
        self.keyframes = KeyframeStore(config.keyframes.rays, torch.device("cpu"))
        self.linker = CovisibilityLinker(self.keyframes, config, ScratchFile())
        self._generator = np.random.default_rng(0)

    def add(self, pose: Pose, believed: Pose | None = None):
        """Links of the view from a pose, of which the store believes another."""
        number = len(self.keyframes)
        frame = frame_at(pose, number, LARGE)
        rays = rays_at(frame, *choose_pixels(frame.depth_m > 0, 512, self._generator))
        self.keyframes.add(frame.stamp_ns, pose if believed is None else believed, rays)
        self.linker.keep(number, frame)
        return [link for link in self.linker.link(number, frame.camera, rays) if link is not None]

    def add_all(self, poses: Sequence[Pose]) -> None:
        for pose in poses:
            self.add(pose)


def distance_and_angle(found: Pose, true: Pose) -> tuple[float, float]:
    twist = log(inverse(true) @ found)
    return float(np.linalg.norm(twist[:3])), float(np.rad2deg(np.linalg.norm(twist[3:])))


@pytest.mark.parametrize(("width", "halvings"), [(320, 0), (160, 1), (100, 2)])
def test_an_image_is_halved_until_it_is_small_enough(width, halvings):
    image = KeyframeImage.of(frame_at(START, 3, LARGE), width)
    size = (LARGE.height >> halvings, LARGE.width >> halvings)
    assert image.gray.shape == image.depth.shape == size
    assert (image.camera.height, image.camera.width) == size
    assert image.stamp_ns == frame_at(START, 3).stamp_ns


def test_a_point_projects_to_the_same_place_of_a_halved_image():
    points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.3], [-0.5, 0.4, 2.0]])
    image = KeyframeImage.of(frame_at(START, 0, LARGE), 100)
    (u, v, _), (small_u, small_v, _) = LARGE.project(points), image.camera.project(points)
    # Pixel centres have whole numbers: the image's edge is at -0.5 in every size.
    np.testing.assert_allclose(small_u, (u + 0.5) / 4.0 - 0.5, atol=1e-9)
    np.testing.assert_allclose(small_v, (v + 0.5) / 4.0 - 0.5, atol=1e-9)
    assert image.camera == LARGE.scaled(0.25)


def test_odd_sides_lose_their_last_pixels():
    camera = PinholeCamera(41, 35, 30.0, 30.0, 20.0, 17.0)
    image = KeyframeImage.of(plain_frame(np.ones((35, 41)), camera), 20)
    assert image.depth.shape == (17, 20)
    assert (image.camera.cx, image.camera.cy) == (9.75, 8.25)


def test_depth_of_a_mixed_block_is_the_near_surfaces():
    depth = np.full((32, 32), 2.0)
    depth[0:2, 0:2] = [[1.0, 1.01], [3.0, 1.0]]
    depth[0:2, 2:4] = [[0.0, 2.0], [0.0, 2.02]]
    depth[0:2, 4:6] = 0.0
    depth[0:2, 6:8] = [[np.nan, 1.5], [np.inf, -np.inf]]
    camera = PinholeCamera(32, 32, 30.0, 30.0, 15.5, 15.5)
    image = KeyframeImage.of(plain_frame(depth, camera), 16)
    first = image.frame().depth_m[0]
    expected = [(1.0 + 1.01 + 1.0) / 3.0, 2.01, 0.0, 1.5, 2.0]
    np.testing.assert_allclose(first[:5], expected, atol=0.5 * DEPTH_UNIT_M + 1e-6)


def test_depth_beyond_what_can_be_stored_does_not_wrap_around():
    image = KeyframeImage.of(plain_frame(np.full((24, 32), 100.0), CAMERA.scaled(0.2)), 320)
    assert image.frame().depth_m.min() > 30.0


def test_an_image_takes_little_memory_and_can_be_registered_again():
    frame = frame_at(START, 0, LARGE)
    image = KeyframeImage.of(frame, LARGE.width // 2)
    assert image.gray.nbytes + image.depth.nbytes < (frame.color.nbytes + frame.depth_m.nbytes) / 8
    restored = image.frame()
    assert restored.color.shape == (LARGE.height // 2, LARGE.width // 2, 3)
    assert restored.color.dtype == np.uint8
    assert restored.depth_m.dtype == np.float32
    exact = frame_at(START, 0, image.camera).depth_m
    assert np.median(np.abs(restored.depth_m - exact)) < 0.002


@pytest.mark.parametrize("error", [np.eye(4), OFF_5_CM], ids=["true pose", "pose 5 cm off"])
def test_a_returning_keyframe_is_tied_to_the_first(error):
    mapper = Mapper()
    assert mapper.add(START) == []
    assert mapper.add(AWAY) == []
    links = mapper.add(RETURN, RETURN @ error)
    assert [(link.first, link.second) for link in links] == [(0, 2)]
    distance, angle = distance_and_angle(links[0].T_first_second, inverse(START) @ RETURN)
    assert distance < 0.005
    assert angle < 0.2


def test_keyframes_that_look_elsewhere_are_not_tied():
    mapper = Mapper()
    mapper.add_all([START, START @ exp(np.array([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]))])
    assert mapper.add(AWAY) == []


@pytest.mark.parametrize("limit", [1, 3])
def test_a_keyframe_gets_no_more_links_than_configured(limit):
    mapper = Mapper(f"keyframes.links={limit}")
    # Aside: the farther away, the less of the view is shared.
    poses = [START @ exp(np.array([0.06 * n, 0.0, 0.0, 0.0, 0.0, 0.0])) for n in range(6)]
    mapper.add_all(poses[:5])
    links = mapper.add(poses[5])
    assert len(links) == limit
    assert len({link.first for link in links}) == limit
    # The view most alike comes first, then the oldest one.
    assert [link.first for link in links][:2] == [4, 0][:limit]


def test_a_believed_pose_far_from_what_the_images_show_is_not_tied():
    mapper = Mapper()
    mapper.add(START)
    assert mapper.add(RETURN, RETURN @ exp(np.array([0.0, 0.0, -0.4, 0.0, 0.0, 0.0]))) == []


IMPLAUSIBLE = {
    "far away": {"T_target_source": exp(1.1 * covisibility.MAX_CORRECTION_M * np.eye(6)[0])},
    "turned": {"T_target_source": exp(1.1 * covisibility.MAX_CORRECTION_RAD * np.eye(6)[4])},
    "few points": {"fitness": 0.9 * covisibility.MIN_FITNESS},
    "other colours": {"agreement": 0.9 * covisibility.MIN_AGREEMENT},
}


class Scripted:
    """A registrar that finds what it is told, relative to the guess."""

    def __init__(self, **changed) -> None:
        self._found = {"T_target_source": np.eye(4), "fitness": 0.95, "agreement": 0.9, **changed}

    def prepare(self, frame: RgbdFrame) -> RgbdFrame:
        return frame

    def register(self, source, target, T_target_source) -> Registration:
        pose = T_target_source @ self._found["T_target_source"]
        fitness, agreement = self._found["fitness"], self._found["agreement"]
        return Registration(pose, np.eye(6), fitness, 0.001, agreement)


class Failing(Scripted):
    """A registrar that never finds anything."""

    def register(self, source, target, T_target_source) -> Registration:
        raise RuntimeError("singular")


def links_by(registrar, monkeypatch):
    monkeypatch.setattr(covisibility, "make_registrar", lambda odometry, sensor: registrar)
    mapper = Mapper()
    mapper.add(START)
    return mapper.add(RETURN)


@pytest.mark.parametrize("changed", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE.keys())
def test_an_implausible_registration_is_not_believed(monkeypatch, changed):
    assert len(links_by(Scripted(), monkeypatch)) == 1
    assert links_by(Scripted(**changed), monkeypatch) == []


def test_a_registration_that_fails_ties_nothing(monkeypatch):
    assert links_by(Failing(), monkeypatch) == []


def test_views_are_found_again_after_many_others(monkeypatch):
    monkeypatch.setattr(covisibility, "make_registrar", lambda odometry, sensor: Scripted())
    mapper = Mapper("keyframes.links=2")
    mapper.add(START)
    mapper.add_all([AWAY @ exp(np.array([0.0, 0.01 * n, 0.0, 0.0, 0.0, 0.0])) for n in range(30)])
    assert [link.first for link in mapper.add(RETURN)] == [0]


def test_a_camera_behind_walls_that_looks_the_same_way_is_not_tried(monkeypatch):
    monkeypatch.setattr(covisibility, "make_registrar", lambda odometry, sensor: Scripted())
    mapper = Mapper()
    # Everything that the camera sees now projects into the image of one 6 m behind.
    mapper.add(START, START @ exp(np.array([0.0, 0.0, -6.0, 0.0, 0.0, 0.0])))
    assert mapper.add(RETURN) == []
