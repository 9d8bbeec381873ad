"""Registration of two RGB-D images by Open3D's hybrid odometry (Park et al. 2017)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose
from peers.reduction import reduced


@dataclass(frozen=True)
class PreparedFrame:
    """A frame at the resolution of registration.

    Attributes:
        image: colour and depth [m].
        intrinsics: 3x3.
        pixels: number of pixels.
        measured_share: share of pixels with depth.
    """

    image: o3d.t.geometry.RGBDImage
    intrinsics: o3d.core.Tensor
    pixels: int
    measured_share: float


@dataclass(frozen=True)
class Registration:
    """How the source frame lies in the target's.

    Attributes:
        T_target_source: (4, 4).
        information: (6, 6) of (rotation, translation) for motions in the target's frame: the sum
            over the pixels that correspond, divided by the number of pixels of the image.
        fitness: share of the measured pixels with a correspondence.
    """

    T_target_source: Pose
    information: NDArray[np.float64]
    fitness: float


FAILED = Registration(np.eye(4), np.zeros((6, 6)), 0.0)


@dataclass(frozen=True)
class RgbdRegistration:
    """Registers pairs of frames.

    Attributes:
        width: images wider than this are halved [px].
        depth_max_m: larger depths are not used [m].
        outlier_m: larger differences of depth are outliers [m].
        iterations: coarse to fine; each level halves the images once more.
    """

    width: int
    depth_max_m: float
    outlier_m: float
    iterations: Sequence[int]

    def prepare(self, frame: RgbdFrame) -> PreparedFrame:
        """What registration needs of a frame."""
        frame = reduced(frame, self.width)
        depth = np.where(frame.depth_m <= self.depth_max_m, frame.depth_m, np.float32(0.0))
        image = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.color))),
            o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth))),
        )
        share = float(np.mean(depth > 0))
        return PreparedFrame(image, o3d.core.Tensor(frame.camera.matrix), depth.size, share)

    def register(
        self,
        source: PreparedFrame,
        target: PreparedFrame,
        guess: Pose,
        *,
        wide: Sequence[int] | None = None,
    ) -> Registration:
        """Register two frames from a first guess of T_target_source; fitness 0 where it fails.

        With `wide`, iterations on a deeper pyramid with thrice the outlier limit come first.
        """
        try:
            if wide is not None:
                guess = self._hybrid(source, target, guess, 3.0 * self.outlier_m, wide)[0]
            pose, fitness = self._hybrid(source, target, guess, self.outlier_m, self.iterations)
            information = o3d.t.pipelines.odometry.compute_odometry_information_matrix(
                source.image.depth,
                target.image.depth,
                source.intrinsics,
                o3d.core.Tensor(pose),
                self.outlier_m,
                1.0,
                self.depth_max_m,
            ).numpy()
        except RuntimeError:
            return FAILED
        if not np.isfinite(pose).all():
            return FAILED
        share = min(1.0, fitness / max(source.measured_share, 1e-3))
        return Registration(pose, information / source.pixels, share)

    def _hybrid(
        self,
        source: PreparedFrame,
        target: PreparedFrame,
        guess: Pose,
        outlier_m: float,
        iterations: Sequence[int],
    ) -> tuple[Pose, float]:
        odometry = o3d.t.pipelines.odometry
        result = odometry.rgbd_odometry_multi_scale(
            source.image,
            target.image,
            source.intrinsics,
            o3d.core.Tensor(guess),
            1.0,
            self.depth_max_m,
            [odometry.OdometryConvergenceCriteria(n, 1e-6, 1e-6) for n in iterations],
            odometry.Method.Hybrid,
            odometry.OdometryLossParams(outlier_m, min(0.05, outlier_m)),
        )
        return result.transformation.numpy(), float(result.fitness)
