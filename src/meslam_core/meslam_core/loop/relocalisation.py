"""Where a lost camera is: keyframes that look alike propose, their images and the map verify.

A pose has to pass three independent tests before it is believed: the direct registration with a
keyframe's image, the distance of the frame's points to the mapped surface, and the colours that
the map has there. `tracking.recovery` asks for the same answer twice in a row besides.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from meslam_core.config import RelocalisationConfig, TrackingConfig
from meslam_core.frame import RgbdFrame
from meslam_core.loop.place_recall import PlaceRecall
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframes import Rays
from meslam_core.odometry import Registration
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.se3 import Pose, inverse, rotation_angle
from meslam_core.tracking.evidence import colour_likeness
from meslam_core.tracking.field_tracker import Alignment, FieldTracker, PosePrior
from meslam_core.tracking.sighting import Sighting

# How far a registration with one keyframe may be wrong [m, rad], and where no more is known than
# where the camera was last.
REGISTERED_SIGMA = (0.02, 0.02)
BELIEVED_SIGMA = (0.1, 0.1)
# The map must not disagree with a registration by more.
MAX_SHIFT_M = 0.1
MAX_SHIFT_RAD = 0.09
# Of keyframes that were tried in vain so many are remembered, and tried after the others.
TRIED = 64


class Relocaliser:
    """Finds a lost camera in the map.

    No training may run while it looks; keyframes are remembered by the thread that trains.

    Args:
        config: what counts as evidence.
        tracking: how frames are aligned with the map.
        atlas: the map.
        linker: keeps the images of keyframes and registers with them; None where none are kept.
    """

    def __init__(
        self,
        config: RelocalisationConfig,
        tracking: TrackingConfig,
        atlas: RegionAtlas,
        linker: CovisibilityLinker | None,
    ) -> None:
        self.places = PlaceRecall(config.keyframes)
        self._config = config
        self._tracker = FieldTracker(tracking)
        self._atlas = atlas
        self._linker = linker
        self._tried: deque[int] = deque(maxlen=TRIED)

    def remember(self, keyframe: int) -> None:
        """Remember what a keyframe looks like that was just linked."""
        if self._linker is not None:
            image = self._linker.image_of(keyframe)
            self.places.add(keyframe, image, self._atlas.keyframes.poses())

    def find(self, frame: RgbdFrame, rays: Rays, T_map_believed: Pose) -> Sighting | None:
        """Look for a frame in the map; None where it is not recognised for certain.

        Args:
            frame: its images.
            rays: its sample, camera frame.
            T_map_believed: (4, 4) where the camera was last, or where odometry has it since;
                asked where no keyframe is remembered.
        """
        if self._linker is None or not len(self.places):
            return self._verified(rays, T_map_believed, BELIEVED_SIGMA, None)
        return self.recognise(frame, rays)

    def recognise(self, frame: RgbdFrame, rays: Rays, before: int | None = None) -> Sighting | None:
        """Look for a frame among keyframes; None where it is not recognised for certain.

        Args:
            frame: its images.
            rays: its sample, camera frame.
            before: only keyframes below this number are asked.
        """
        if self._linker is None:
            return None
        image = self._linker.image(frame)
        prepared = self._linker.prepare(image)
        count = self._config.candidates
        for keyframe in self.places.propose(image, count, self._tried, before):
            found = self._linker.find(keyframe, prepared, np.eye(4))
            if found is not None and self._looks_alike(found):
                pose = self._atlas.keyframes.pose(keyframe) @ found.T_target_source
                sighting = self._verified(rays, pose, REGISTERED_SIGMA, keyframe)
                if sighting is not None:
                    self._tried.clear()
                    return sighting
            self._tried.append(keyframe)
        return None

    def attests(self, frame: RgbdFrame, keyframe: int, T_map_camera: Pose) -> bool:
        """Whether a keyframe's image shows that a frame was taken at a pose, whatever the map says.

        Args:
            frame: its images.
            keyframe: number of one nearby.
            T_map_camera: (4, 4).
        """
        if self._linker is None or keyframe not in self.places.keyframes:
            return False
        guess = inverse(self._atlas.keyframes.pose(keyframe)) @ T_map_camera
        found = self._linker.find(keyframe, self._linker.prepare(self._linker.image(frame)), guess)
        if found is None or not self._looks_alike(found):
            return False
        apart, limits = inverse(guess) @ found.T_target_source, self._config
        near = float(np.linalg.norm(apart[:3, 3])) <= limits.agreement_m
        return near and rotation_angle(apart) <= np.deg2rad(limits.agreement_deg)

    def forget(self, since: int) -> None:
        """Forget the keyframes from a number on: they were not taken where they seemed to be."""
        self.places.forget(since)

    def _looks_alike(self, found: Registration) -> bool:
        """Whether two images show the same thing, and not only one of the same shape."""
        limits = self._config
        return (
            found.fitness >= limits.min_fitness
            and found.agreement >= limits.min_image_likeness * found.fitness
        )

    def _verified(
        self, rays: Rays, T_map_camera: Pose, sigma: tuple[float, float], keyframe: int | None
    ) -> Sighting | None:
        """The pose refined on the map, if the map shows what the frame shows."""
        region = self._atlas.nearest(T_map_camera[:3, 3])
        self._atlas.look_into(region)
        prior = PosePrior(T_map_camera, np.diag(np.repeat(np.square(sigma), 3)))
        alignment = self._tracker.align(region, rays, T_map_camera, prior)
        if not self._fits(alignment, T_map_camera):
            return None
        likeness = colour_likeness(region, rays, alignment.T_map_camera)
        if likeness is None:
            # Without colours the depth alone would have to tell two places apart.
            return None if keyframe is None else Sighting(region, alignment, keyframe)
        if likeness < self._config.min_colour_likeness:
            return None
        return Sighting(region, alignment, keyframe)

    def _fits(self, alignment: Alignment, T_map_camera: Pose) -> bool:
        limits = self._config
        if not np.isfinite(alignment.T_map_camera).all():
            return False
        shift = inverse(T_map_camera) @ alignment.T_map_camera
        return (
            alignment.observed_ratio >= limits.min_observed_ratio
            and alignment.inlier_ratio >= limits.min_inlier_ratio
            and alignment.residual_m <= limits.max_residual_m
            and float(np.linalg.norm(shift[:3, 3])) <= MAX_SHIFT_M
            and rotation_angle(shift) <= MAX_SHIFT_RAD
        )
