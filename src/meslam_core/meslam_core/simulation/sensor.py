"""What a D435 makes of an ideal view: stereo depth with its errors and holes, and a noisy colour.

The figures follow Intel's *Best-Known-Methods for Tuning RealSense D400 Depth Cameras*, 2019, and
Ahn et al., *Analysis and noise modeling of the Intel RealSense D435 for mobile robots*, 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.simulation.renderer import View

D435_CAMERA = PinholeCamera(width=640, height=480, fx=615.0, fy=615.2, cx=320.6, cy=241.3)
"""The colour camera of a D435 at 640x480, to which depth is registered."""


@dataclass(frozen=True)
class D435:
    """Noise of the depth and the colour imager.

    Attributes:
        baseline_m: between the two infrared imagers [m].
        depth_focal_px: focal length of the depth image at 848x480 [px].
        disparity_noise_px: standard deviation of the matched disparity [px].
        calibration_error_px: standard deviation of the disparity's smooth, constant error, which
            no averaging of frames removes [px].
        subpixel: disparities come in steps of 1/subpixel [px].
        nearest_m, farthest_m: range that is reported [m].
        grazing_cosine: surfaces below this cosine to the ray mostly return nothing.
        edge_jump: relative step of depth at which matching windows see two surfaces.
        match_margin: how far matching on a good surface at 1 m is from failing, in deviations.
        match_margin_loss: what a metre more takes from that margin.
        color_noise: standard deviation of a mid-grey pixel, of 255.
        exposure_drift: largest relative change of exposure over a recording.
    """

    baseline_m: float = 0.050
    depth_focal_px: float = 425.0
    disparity_noise_px: float = 0.08
    calibration_error_px: float = 0.03
    subpixel: int = 32
    nearest_m: float = 0.28
    farthest_m: float = 6.0
    grazing_cosine: float = 0.17
    edge_jump: float = 0.04
    match_margin: float = 2.65
    match_margin_loss: float = 0.38
    color_noise: float = 2.2
    exposure_drift: float = 0.03

    def distortion(self, camera: PinholeCamera, seed: int) -> NDArray[np.float32]:
        """Disparity error (H, W) [px] that one specimen of the sensor makes in every frame."""
        rng = np.random.default_rng((seed, 0xCA11B))
        return _blobs(
            rng, (camera.height, camera.width), camera.width / 5, self.calibration_error_px
        )

    def depth(
        self,
        view: View,
        camera: PinholeCamera,
        distortion: NDArray[np.float32],
        rng: np.random.Generator,
    ) -> NDArray[np.float32]:
        """Measured depth (H, W) [m] in whole millimetres, 0 where matching fails."""
        disparity_of_1m = np.float32(self.baseline_m * self.depth_focal_px)
        ideal = view.depth_m
        valid = (ideal >= self.nearest_m) & (ideal <= self.farthest_m)
        safe = np.where(valid, ideal, np.float32(1))
        true_disparity = disparity_of_1m / safe
        noise = _blobs(rng, ideal.shape, 6.0, 0.75) + _blobs(rng, ideal.shape, 2.5, 0.66)
        disparity = true_disparity + distortion + np.float32(self.disparity_noise_px) * noise
        disparity = np.round(disparity * self.subpixel) / np.float32(self.subpixel)
        measured = disparity_of_1m / np.maximum(disparity, np.float32(1e-3))
        keep = valid & self._matched(view, safe, camera, rng)
        keep &= (measured >= self.nearest_m) & (measured <= self.farthest_m)
        return np.where(keep, np.round(measured * 1000), 0).astype(np.float32) * np.float32(0.001)

    def color(
        self, view: View, rng: np.random.Generator, exposure: float = 1.0
    ) -> NDArray[np.uint8]:
        """Colour image (H, W, 3) uint8: slightly soft, with noise that grows with the signal."""
        soft = np.asarray(cv2.GaussianBlur(view.color, (0, 0), 0.55), np.float32)
        soft *= np.float32(exposure)
        strength = soft * np.float32(1 / 128)
        strength += np.float32(0.15)
        np.sqrt(strength, out=strength)
        grain = rng.standard_normal(soft.shape, np.float32)
        grain *= strength
        grain *= np.float32(self.color_noise)
        grain += soft
        np.rint(grain, out=grain)
        return np.clip(grain, 0, 255, out=grain).astype(np.uint8)

    def exposure(self, time_s: float, seed: int) -> float:
        """Relative exposure at a time: automatic exposure wanders slowly."""
        phase = float(np.random.default_rng((seed, 0xE9)).uniform(0, 2 * np.pi))
        return 1.0 + self.exposure_drift * float(np.sin(0.7 * time_s + phase))

    def _matched(
        self,
        view: View,
        depth: NDArray[np.float32],
        camera: PinholeCamera,
        rng: np.random.Generator,
    ) -> NDArray[np.bool_]:
        """Pixels (H, W) whose disparity the stereo matching finds."""
        size = depth.shape
        hidden = _hidden_from_right(depth, np.float32(camera.fx * self.baseline_m))
        reach = max(1, round(2 * camera.fx / D435_CAMERA.fx))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        spread = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel)
        # A plane seen at a slant spans some depth too; that is no edge.
        slant = np.sqrt(np.maximum(1 / np.maximum(view.incidence, np.float32(0.1)) ** 2 - 1, 0))
        planar = (2 * reach + 1) * depth * slant / np.float32(camera.fx)
        edge = spread > planar * np.float32(1.5) + np.float32(self.edge_jump) * depth
        # Failures come in blobs of the matching window's size: thresholds on smooth noise.
        noise = _blobs(rng, size, 5.0, 1.0)
        grazing = view.incidence < np.float32(self.grazing_cosine) * (1 + np.float32(0.3) * noise)
        margin = np.float32(self.match_margin) - np.float32(self.match_margin_loss) * (depth - 1)
        return ~(hidden | (edge & (noise > -0.5)) | grazing | (noise > margin))


def _hidden_from_right(
    depth: NDArray[np.float32], disparity_of_1m: np.float32
) -> NDArray[np.bool_]:
    """Pixels (H, W) that the right imager cannot see because something nearer covers them."""
    columns = np.arange(depth.shape[1], dtype=np.float32)
    matches = columns - disparity_of_1m / depth
    leftmost = np.minimum.accumulate(matches[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, :-1] = matches[:, :-1] > leftmost[:, 1:] + np.float32(0.5)
    return hidden


def _blobs(
    rng: np.random.Generator, size: tuple[int, ...], cell_px: float, deviation: float
) -> NDArray[np.float32]:
    """Smooth noise (H, W) with features of about `cell_px` and the given standard deviation."""
    height, width = size
    coarse = (int(np.ceil(height / cell_px)) + 1, int(np.ceil(width / cell_px)) + 1)
    grid = rng.standard_normal(coarse, np.float32)
    smooth = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    # Interpolation between independent nodes lowers the deviation to 0.83.
    return np.asarray(smooth * np.float32(deviation / 0.83), np.float32)
