"""When a frame becomes a keyframe: iMAP's rule on rendered depth, motion and overlap."""

from __future__ import annotations

import numpy as np
import torch

from meslam_core.camera import PinholeCamera
from meslam_core.config import FieldConfig, KeyframesConfig
from meslam_core.field.rendering import render
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, rotation_angle

COARSE_SAMPLES = 24
FINE_SAMPLES = 8


class KeyframePolicy:
    """Decides about keyframes; no minimum interval, fast rotation needs one every frame."""

    PIXELS = 256

    def __init__(self, keyframes: KeyframesConfig, field: FieldConfig) -> None:
        self.config = keyframes
        self.field = field

    def is_keyframe(
        self,
        region: Region,
        keyframes: KeyframeStore,
        reference: int,
        camera: PinholeCamera,
        T_map_camera: Pose,
        rays: Rays,
    ) -> bool:
        """Whether a frame shows enough that its reference keyframe and the map do not.

        Args:
            region: the working region.
            keyframes, reference: the store and the number of the reference keyframe.
            camera: of the frame.
            T_map_camera: (4, 4) of the frame.
            rays: some of the frame's, camera frame.
        """
        offset = inverse(keyframes.pose(reference)) @ T_map_camera
        if np.linalg.norm(offset[:3, 3]) > self.config.translation_m:
            return True
        if np.rad2deg(rotation_angle(offset)) > self.config.rotation_deg:
            return True
        if self._overlap(camera, offset, rays) < self.config.overlap:
            return True
        return self._agreement(region, T_map_camera, rays) < self.config.agreement

    def _overlap(self, camera: PinholeCamera, T_reference_camera: Pose, rays: Rays) -> float:
        """Share of the points that project into the reference keyframe's image."""
        points = rays.directions.numpy() * rays.distances_m.numpy()[:, None]
        points = points @ T_reference_camera[:3, :3].T + T_reference_camera[:3, 3]
        u, v, z = camera.project(points)
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        return float(np.mean(inside))

    def _agreement(self, region: Region, T_map_camera: Pose, rays: Rays) -> float:
        """Share of pixels whose rendered depth agrees with the measured one (iMAP, Sec. 3.4)."""
        rendered = self.rendered_distances(region, T_map_camera, rays)
        error = np.abs(rendered - rays.distances_m.numpy()) / rays.distances_m.numpy()
        return float(np.mean(error < self.config.agreement_tolerance))

    def rendered_distances(self, region: Region, T_map_camera: Pose, rays: Rays) -> np.ndarray:
        """Rendered distances (R,) along rays [m]; samples reach past the farthest measurement."""
        count = len(rays)
        far = 1.2 * float(rays.distances_m.max())
        along = torch.linspace(0.05, far, COARSE_SAMPLES).expand(count, -1)
        values = self._values(region, T_map_camera, rays, along)
        behind = values[..., 0] > 0
        first = torch.where(behind.any(1), behind.float().argmax(1), COARSE_SAMPLES - 1)
        hit = along.gather(1, first[:, None])
        spacing = far / COARSE_SAMPLES
        fine = hit + torch.linspace(-spacing, spacing / 2, FINE_SAMPLES)
        along = torch.cat([along, fine.clamp(min=0.01)], dim=1).sort(dim=1).values
        values = self._values(region, T_map_camera, rays, along)
        return render(values[..., 0], values[..., 1:], along, self.field).distance_m.numpy()

    def _values(
        self, region: Region, T_map_camera: Pose, rays: Rays, along: torch.Tensor
    ) -> torch.Tensor:
        pose = torch.from_numpy(T_map_camera).float()
        directions = rays.directions @ pose[:3, :3].T
        points = pose[:3, 3] + along[..., None] * directions[:, None]
        inputs = region.to_region(points.reshape(-1, 3)).contiguous().numpy()
        return torch.from_numpy(region.field.predict(inputs)).reshape(*along.shape, 4)
