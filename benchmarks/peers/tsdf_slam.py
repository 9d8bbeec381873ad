"""Dense SLAM on a truncated signed distance field: `open3d.t.pipelines.slam`.

As in KinectFusion (Newcombe et al. 2011) every frame is registered with the field, ray-cast from
the expected pose, and then integrated. The configuration is the best of `TRIED`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, inverse, orthonormalized
from peers.reduction import reduced

# Units a metre of the integer depth that Open3D integrates; the TUM benchmark's, the finest used.
DEPTH_SCALE = 5000.0
BLOCK_RESOLUTION = 16
# Open3D 0.20 integrates the pixel left of and above the projection instead of the nearest
# (its issue 7580); half a pixel more of the principal point makes truncation rounding.
TRUNCATED_PIXEL = 0.5

# ATE RMSE [cm] for settings that differ from the defaults below. Without centre_pixels means that
# Open3D's half pixel was left in.
TRIED = {
    "tum_fr1_xyz": {
        "defaults": 2.16,
        "voxel_m=0.004 (half the speed, twice the memory)": 2.10,
        "hybrid=True": 3.44,
        "centre_pixels=False": 2.29,
        "centre_pixels=False voxel_m=0.01": 2.57,
        "centre_pixels=False voxel_m=0.01 depth_outlier_m=0.04": 2.39,
        "centre_pixels=False voxel_m=0.01 constant_velocity=False": 2.56,
        "centre_pixels=False voxel_m=0.01 iterations=(6, 3, 1)": 2.58,
        "centre_pixels=False voxel_m=0.01 hybrid=True": 3.72,
        "centre_pixels=False voxel_m=0.01 hybrid=True width=640": 4.58,
        "centre_pixels=False voxel_m=0.02": 4.00,
    },
    "d435_desk": {
        "hybrid=True trusted_weight=1 voxel_m=0.01": 28.7,
        "hybrid=True trusted_weight=1 voxel_m=0.02 depth_outlier_m=0.2": 32.2,
        "hybrid=True trusted_weight=2 iterations=(20, 15, 10) (loses 115 frames)": 33.5,
        "voxel_m=0.01 (lost from the third frame on)": None,
    },
    "livingroom": {
        "defaults": 1.51,
        "hybrid=True": 1.16,
        "hybrid=True voxel_m=0.01 width=640": 1.32,
        "centre_pixels=False voxel_m=0.01 hybrid=True width=640": 1.16,
    },
}
# Settings that differ from the defaults by recording. From the D435's sparse, noisy depth alone
# no frame is tracked, and few of its voxels are seen three times; rendered images are sharp and
# fit their depth, so that colour helps.
SETTINGS: dict[str, tuple[str, ...]] = {
    "livingroom": ("hybrid=True",),
    "d435_desk": ("hybrid=True", "trusted_weight=1.0", "voxel_m=0.01"),
}


@dataclass(frozen=True)
class TsdfSlamConfig:
    """Settings of the peer.

    Attributes:
        width: images wider than this are halved [px].
        voxel_m: edge of a voxel [m].
        truncation_voxels: truncation distance in voxels.
        depth_min_m, depth_max_m: depths that are used [m].
        depth_outlier_m: larger differences of depth are outliers of tracking [m].
        trusted_weight: voxels seen in this many frames are ray-cast; fewer at the start.
        hybrid: track by depth and colour instead of by depth alone.
        iterations: of tracking, coarse to fine; each level halves the images once more.
        constant_velocity: expect the last motion again, else no motion.
        min_fitness: share of pixels with a correspondence below which a frame is lost.
        max_step_m, max_step_deg: a larger correction of the expected pose means a lost frame.
        centre_pixels: counteract the half pixel by which Open3D integrates depth to one side.
        blocks: initial number of voxel blocks; more are made where needed.
    """

    width: int = 320
    voxel_m: float = 0.0058
    truncation_voxels: float = 8.0
    depth_min_m: float = 0.1
    depth_max_m: float = 5.0
    depth_outlier_m: float = 0.07
    trusted_weight: float = 3.0
    hybrid: bool = False
    iterations: tuple[int, ...] = (20, 10, 5)
    constant_velocity: bool = True
    min_fitness: float = 0.1
    max_step_m: float = 0.15
    max_step_deg: float = 20.0
    centre_pixels: bool = True
    blocks: int = 10000


class TsdfSlam:
    """Frame-to-model tracking and integration; a lost frame keeps the last pose.

    Args:
        config: settings.
    """

    def __init__(self, config: TsdfSlamConfig) -> None:
        # Open3D reports every frame that a field without colour is asked for.
        o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
        self._config = config
        self._model = o3d.t.pipelines.slam.Model(
            config.voxel_m,
            BLOCK_RESOLUTION,
            config.blocks,
            o3d.core.Tensor(np.eye(4)),
            o3d.core.Device("CPU:0"),
        )
        self._integrated = 0
        self._updates = 0
        self._T_map_last: Pose = np.eye(4)
        self._motion: Pose = np.eye(4)
        self._tracked: list[Pose] = []

    def process(self, frame: RgbdFrame) -> Pose | None:
        """Track a frame against the field, then integrate it; None when it is lost."""
        frame = reduced(frame, self._config.width)
        image = self._slam_frame(frame)
        pose = self._tracked_pose(frame, image) if self._integrated else np.eye(4)
        if pose is None:
            self._motion = np.eye(4)
            return None
        if self._integrated:
            self._motion = orthonormalized(inverse(self._T_map_last) @ pose)
        self._T_map_last = pose
        self._place(pose)
        config = self._config
        centred = self._slam_frame(frame, TRUNCATED_PIXEL if config.centre_pixels else 0.0)
        self._model.integrate(centred, DEPTH_SCALE, config.depth_max_m, config.truncation_voxels)
        self._integrated += 1
        self._tracked.append(pose)
        return pose

    def finish(self) -> list[Pose]:
        """The online poses: frame-to-model tracking corrects none of them later."""
        return self._tracked

    def _tracked_pose(self, frame: RgbdFrame, image: o3d.t.pipelines.slam.Frame) -> Pose | None:
        """The first plausible pose from the expected motion, then from the last pose."""
        expected = [self._T_map_last]
        if self._config.constant_velocity:
            expected.insert(0, self._T_map_last @ self._motion)
        for T_map_expected in expected:
            correction = self._correction(frame, image, T_map_expected)
            if correction is not None:
                return orthonormalized(T_map_expected @ correction)
        return None

    def _correction(
        self, frame: RgbdFrame, image: o3d.t.pipelines.slam.Frame, T_map_expected: Pose
    ) -> Pose | None:
        """T_expected_camera by registration with the ray-cast field; None when it fails."""
        config = self._config
        odometry = o3d.t.pipelines.odometry
        self._place(T_map_expected)
        view = self._empty_frame(frame)
        try:
            self._model.synthesize_model_frame(
                view,
                DEPTH_SCALE,
                config.depth_min_m,
                config.depth_max_m,
                config.truncation_voxels,
                config.hybrid,
                min(config.trusted_weight, float(self._integrated)),
            )
            result = self._model.track_frame_to_model(
                image,
                view,
                DEPTH_SCALE,
                config.depth_max_m,
                config.depth_outlier_m,
                odometry.Method.Hybrid if config.hybrid else odometry.Method.PointToPlane,
                [odometry.OdometryConvergenceCriteria(n, 1e-6, 1e-6) for n in config.iterations],
            )
        except RuntimeError:
            return None
        correction = result.transformation.numpy()
        # Open3D counts among all pixels; a D435 measures only half of them.
        measured = max(float(np.mean(frame.depth_m > 0)), 1e-3)
        if not np.isfinite(correction).all() or result.fitness / measured < config.min_fitness:
            return None
        angle = np.arccos(np.clip((np.trace(correction[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        moved = float(np.linalg.norm(correction[:3, 3]))
        if moved > config.max_step_m or np.rad2deg(angle) > config.max_step_deg:
            return None
        return correction

    def _place(self, T_map_camera: Pose) -> None:
        """Tell the model where it is looked at from."""
        # A number that is not the next one makes Open3D warn.
        self._model.update_frame_pose(self._updates, o3d.core.Tensor(T_map_camera))
        self._updates += 1

    def _slam_frame(self, frame: RgbdFrame, shift_px: float = 0.0) -> o3d.t.pipelines.slam.Frame:
        """A frame for Open3D, its principal point shifted."""
        image = self._empty_frame(frame, shift_px)
        usable = (frame.depth_m > 0) & (frame.depth_m < np.iinfo(np.uint16).max / DEPTH_SCALE)
        depth = np.rint(np.where(usable, frame.depth_m, 0.0) * DEPTH_SCALE).astype(np.uint16)
        as_image = o3d.t.geometry.Image
        image.set_data_from_image("depth", as_image(o3d.core.Tensor(depth)))
        color = np.ascontiguousarray(frame.color)
        image.set_data_from_image("color", as_image(o3d.core.Tensor(color)))
        return image

    @staticmethod
    def _empty_frame(frame: RgbdFrame, shift_px: float = 0.0) -> o3d.t.pipelines.slam.Frame:
        camera = frame.camera
        matrix = camera.matrix
        matrix[:2, 2] += shift_px
        return o3d.t.pipelines.slam.Frame(
            camera.height, camera.width, o3d.core.Tensor(matrix), o3d.core.Device("CPU:0")
        )
