"""The sensor's errors."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.camera import PinholeCamera
from meslam_core.simulation.renderer import View
from meslam_core.simulation.sensor import D435

CAMERA = PinholeCamera(320, 240, 307.5, 307.5, 159.5, 119.5)
NO_DISTORTION = np.zeros((240, 320), np.float32)


def view_of(depth_m: np.ndarray | float, incidence: float = 1.0, grey: float = 128.0) -> View:
    depth = np.broadcast_to(np.float32(depth_m), (240, 320)).astype(np.float32)
    return View(
        np.full((240, 320, 3), grey, np.float32), depth, np.full(depth.shape, incidence, np.float32)
    )


def measure(view: View, seed: int = 0) -> np.ndarray:
    return D435().depth(view, CAMERA, NO_DISTORTION, np.random.default_rng(seed))


def test_depth_noise_grows_with_the_square_of_the_distance():
    spread = {}
    for distance in (1.0, 2.0, 4.0):
        depth = measure(view_of(distance))
        spread[distance] = depth[depth > 0].std()
        assert depth[depth > 0].mean() == pytest.approx(distance, rel=0.01)
    assert 0.003 < spread[1.0] < 0.006
    assert spread[2.0] / spread[1.0] == pytest.approx(4, rel=0.2)
    assert spread[4.0] / spread[2.0] == pytest.approx(4, rel=0.2)


def test_noise_is_alike_in_neighbouring_pixels_only():
    noise = measure(view_of(2.0))
    noise = np.where(noise > 0, noise - 2.0, np.nan)

    def correlation(shift: int) -> float:
        one, other = noise[:, :-shift].ravel(), noise[:, shift:].ravel()
        both = np.isfinite(one) & np.isfinite(other)
        return float(np.corrcoef(one[both], other[both])[0, 1])

    assert correlation(1) > 0.5
    assert abs(correlation(20)) < 0.1


def test_depth_comes_in_disparity_steps_and_millimetres():
    depth = measure(view_of(3.0))
    values = np.unique(depth[depth > 0])
    np.testing.assert_allclose(values * 1000, np.round(values * 1000), atol=1e-3)
    steps = np.diff(values)
    # 3 m squared / (32 steps a pixel * 21.25 px m) = 13 mm.
    assert np.median(steps) == pytest.approx(0.0132, abs=0.002)


@pytest.mark.parametrize("distance", [0.2, 6.5])
def test_out_of_range_is_unknown(distance):
    assert not measure(view_of(distance)).any()


def test_good_surface_is_nearly_complete_and_far_one_less():
    near, far = ((measure(view_of(d)) > 0).mean() for d in (1.0, 4.0))
    assert near > 0.98
    assert 0.80 < far < near


def test_grazing_surface_is_lost():
    assert (measure(view_of(1.5, incidence=0.08)) > 0).mean() < 0.05
    assert (measure(view_of(1.5, incidence=0.35)) > 0).mean() > 0.9


def test_background_is_hidden_left_of_a_near_object():
    depth = np.full((240, 320), 3.0, np.float32)
    depth[:, 150:200] = 1.0
    valid = measure(view_of(depth)) > 0
    # 307.5 px * 0.05 m * (1/1 m - 1/3 m) = 10 px.
    assert valid[:, 141:149].mean() < 0.05
    assert valid[:, 203:212].mean() > 0.8
    assert valid[:, 125:138].mean() > 0.8
    assert valid[:, 155:195].mean() > 0.9


def test_distortion_is_constant_smooth_and_small():
    first, second = D435().distortion(CAMERA, 3), D435().distortion(CAMERA, 3)
    np.testing.assert_array_equal(first, second)
    assert first.std() == pytest.approx(0.03, rel=0.5)
    assert np.abs(np.diff(first, axis=1)).max() < 0.01


def test_color_noise_is_unbiased_and_grows_with_the_signal():
    spread = []
    for grey in (40.0, 200.0):
        image = D435().color(view_of(1.0, grey=grey), np.random.default_rng(0)).astype(float)
        assert image.mean() == pytest.approx(grey, abs=0.1)
        spread.append(image.std())
    assert 0.5 < spread[0] < spread[1] < 4.0


def test_exposure_wanders_slowly():
    exposures = [D435().exposure(t / 15, seed=1) for t in range(300)]
    assert np.ptp(exposures) > 0.03
    assert np.abs(np.diff(exposures)).max() < 0.003
