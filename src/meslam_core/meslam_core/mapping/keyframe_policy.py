"""When a frame becomes a keyframe: iMAP's rule on rendered depth, motion and overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.config import FieldConfig, KeyframesConfig
from meslam_core.field.rendering import MAX_OPTICAL_DEPTH
from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, rotation_angle

Floats = NDArray[np.float32]

NEAREST_M = 0.05
COARSE_SAMPLES = 24
FINE_SAMPLES = 8
# A rendered ray costs as much as many projected points; this share of them decides as surely.
RENDERED_EVERY = 2
# A keyframe that is so old stands for what is seen again within so many times the distances at
# which a new one is made: who drives the same ways for hours needs no more of them.
REVISITED_AFTER_NS = 60_000_000_000
REVISITED_SLACK = 2.0


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
        slack: float = 1.0,
    ) -> bool:
        """Whether a frame shows enough that its reference keyframe and the map do not.

        Args:
            region: the working region.
            keyframes, reference: the store and the number of the reference keyframe.
            camera: of the frame.
            T_map_camera: (4, 4) of the frame.
            rays: some of the frame's, camera frame.
            slack: the limits to the reference are so many times as wide.
        """
        offset = inverse(keyframes.pose(reference)) @ T_map_camera
        if np.linalg.norm(offset[:3, 3]) > slack * self.config.translation_m:
            return True
        if np.rad2deg(rotation_angle(offset)) > slack * self.config.rotation_deg:
            return True
        if self._overlap(camera, offset, rays) < self.config.overlap / slack:
            return True
        some = slice(None, None, RENDERED_EVERY)
        rendered = Rays(rays.directions[some], rays.distances_m[some], rays.colors[some])
        return self._agreement(region, T_map_camera, rendered) < self.config.agreement

    def revisited(
        self, region: Region, keyframes: KeyframeStore, stamp_ns: int, T_map_camera: Pose
    ) -> int | None:
        """The nearest keyframe from long ago that shows what a frame shows; None without any.

        Args:
            region: the working region.
            keyframes: the store.
            stamp_ns: of the frame's image [ns].
            T_map_camera: (4, 4) of the frame.
        """
        # Of an earlier session there are no images.
        known = [k for k in region.keyframes if k >= keyframes.fixed]
        old = [k for k in known if stamp_ns - keyframes.stamps_ns[k] > REVISITED_AFTER_NS]
        if not old:
            return None
        rotations, translations = keyframes.pose_arrays()
        far = np.linalg.norm(translations[old] - T_map_camera[:3, 3], axis=1)
        far /= REVISITED_SLACK * self.config.translation_m
        cosines = 0.5 * (np.einsum("kij,ij->k", rotations[old], T_map_camera[:3, :3]) - 1.0)
        turned = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
        turned /= REVISITED_SLACK * self.config.rotation_deg
        apart = np.maximum(far, turned)
        nearest = int(np.argmin(apart))
        return old[nearest] if apart[nearest] < 1.0 else None

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

    def rendered_distances(self, region: Region, T_map_camera: Pose, rays: Rays) -> Floats:
        """Rendered distances (R,) along rays [m]; samples reach past the farthest measurement."""
        far = 1.2 * float(rays.distances_m.max())
        coarse = np.linspace(NEAREST_M, far, COARSE_SAMPLES, dtype=np.float32)
        coarse = np.tile(coarse, (len(rays), 1))
        values = _distance_field(region, T_map_camera, rays, coarse)
        behind = values > 0.0
        behind[:, -1] = True
        hit = np.take_along_axis(coarse, behind.argmax(1)[:, None], 1)
        spacing = far / COARSE_SAMPLES
        fine = hit + np.linspace(-spacing, spacing / 2, FINE_SAMPLES, dtype=np.float32)
        fine = np.maximum(fine, np.float32(0.01))
        along = np.concatenate([coarse, fine], axis=1)
        values = np.concatenate([values, _distance_field(region, T_map_camera, rays, fine)], axis=1)
        order = along.argsort(axis=1)
        along = np.take_along_axis(along, order, 1)
        return self._expected_distance(np.take_along_axis(values, order, 1), along)

    def _expected_distance(self, distance_field: Floats, along: Floats) -> Floats:
        """The distance (R,) of `field.rendering.render`, without a graph to learn from."""
        field = self.field
        last = np.full_like(along[:, :1], field.truncation_m)
        optical_depth = np.maximum(distance_field, np.float32(0.0)) * np.diff(
            along, append=along[:, -1:] + last
        )
        optical_depth = np.minimum(field.density_scale * optical_depth, MAX_OPTICAL_DEPTH)
        passed = np.cumsum(optical_depth, axis=1) - optical_depth
        weights = np.exp(-passed) * -np.expm1(-optical_depth)
        opacity = np.maximum(weights.sum(axis=1), 1e-4)
        distance: Floats = (weights * along).sum(axis=1) / opacity
        return distance


def _distance_field(region: Region, T_map_camera: Pose, rays: Rays, along: Floats) -> Floats:
    """f (R, S) at distances (R, S) along rays [m]."""
    # Composed before it meets the points: far from the map's origin single precision is coarse.
    T_region_camera = inverse(region.T_map_region) @ T_map_camera / region.half_side_m
    origin = T_region_camera[:3, 3].astype(np.float32)
    directions = rays.directions.numpy() @ T_region_camera[:3, :3].T.astype(np.float32)
    points = origin + along[..., None] * directions[:, None]
    values = region.field.predict(points.reshape(-1, 3))
    return values[:, 0].reshape(along.shape)
