"""Whether a region that was come back to is where the camera believes it to be."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np

from meslam_core.camera import PinholeCamera
from meslam_core.frame import RgbdFrame
from meslam_core.loop.pose_graph import optimised_poses
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframe_links import MeasuredMotion
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose, inverse, rotation_angle

log = logging.getLogger(__name__)

# Where a region says that the camera is farther from where it is believed to be, the path since
# is corrected; smaller differences training and links even out.
TOLERATED_M = 0.02
TOLERATED_RAD = 0.01
# Where a region was recognised after an earlier rest, its place among the others is known as well
# as it will be: more than this is needed to correct the path once more.
SETTLED_M = 0.06
SETTLED_RAD = 0.035
# After so many keyframes that told nothing only every so many are asked.
MANY_DOUBTS = 8
THEN_EVERY = 4


class RegionRecogniser:
    """Asks regions that woke whether they know the view, and corrects the path by the answer.

    Until then such a region is not trained, what does not agree with its map would spoil it, and
    the region before goes on working as far as its map reaches.

    Args:
        atlas: its regions are moved by corrections.
        linker: finds a keyframe among older ones.

    Attributes:
        corrections: so many times the path was corrected.
    """

    def __init__(self, atlas: RegionAtlas, linker: CovisibilityLinker) -> None:
        self.corrections = 0
        self._atlas = atlas
        self._keyframes = atlas.keyframes
        self._linker = linker

    def ask(
        self, region: Region, keyframe: int, camera: PinholeCamera, rays: Rays
    ) -> Iterator[None]:
        """Look for a keyframe's view among those of a region that woke, a registration at a time.

        Args:
            region: awake and not confirmed.
            keyframe: number of one whose images are kept.
            camera: of its frame.
            rays: its sample, camera frame.
        """
        doubts = region.doubts + 1
        if doubts > MANY_DOUBTS and doubts % THEN_EVERY:
            region.doubts = doubts
            return
        among = range(region.known_until)
        # Where no registration is made, the camera has yet to come to what was seen.
        for links in self._linker.recognise(keyframe, camera, rays, among):
            region.doubts = doubts
            if region.confirmed:
                return
            if links:
                self._believe(links)
                region.confirmed = region.recognised = True
                return
            yield

    def confirm(self, keyframe: int, frame: RgbdFrame, T_map_camera: Pose) -> bool:
        """Whether a frame is where it is believed to be, as a keyframe's image tells.

        The regions that were trained with the keyframe are then known to be where they are. Where
        all of them have been recognised before, small differences are left to tracking: they are
        those of the map, and would be found again at every visit.

        Args:
            keyframe: number of one whose images are kept.
            frame: whose view it shares.
            T_map_camera: (4, 4) where that is believed to be.
        """
        T_map_keyframe = self._keyframes.pose(keyframe)
        guess = inverse(T_map_keyframe) @ T_map_camera
        found = self._linker.find(keyframe, self._linker.prepare(self._linker.image(frame)), guess)
        if found is None:
            return False
        apart = inverse(guess) @ found.T_target_source
        regions = [
            region
            for region in self._atlas.doubtful
            if keyframe < region.known_until and keyframe in region.keyframes
        ]
        settled = bool(regions) and all(region.recognised for region in regions)
        if _is_far(apart) and not (settled and not _is_far(apart, SETTLED_M, SETTLED_RAD)):
            return False
        for region in regions:
            region.confirmed = region.recognised = True
        return True

    def _believe(self, links: list[MeasuredMotion]) -> None:
        keyframes = self._keyframes
        # The last one agreed with the others.
        link = links[-1]
        found = keyframes.pose(link.first) @ link.T_first_second
        apart = inverse(keyframes.pose(link.second)) @ found
        if _is_far(apart):
            before = keyframes.poses()
            after = optimised_poses(before, keyframes.links, links)
            everyone = np.arange(1, len(after))
            keyframes.set_poses(
                everyone,
                after[1:, :3, :3].astype(np.float32),
                after[1:, :3, 3].astype(np.float32),
            )
            self._atlas.correct(before, after)
            self.corrections += 1
            log.info(
                "keyframe %d was recognised %.1f cm from where it was believed to be",
                link.second,
                float(np.linalg.norm(apart[:3, 3])) * 100,
            )
        for each in links:
            keyframes.add_link(each.first, each.second, each.T_first_second)


def _is_far(
    apart: Pose, tolerated_m: float = TOLERATED_M, tolerated_rad: float = TOLERATED_RAD
) -> bool:
    """Whether two poses differ by more, if nothing else is said, than training evens out."""
    far = float(np.linalg.norm(apart[:3, 3])) > tolerated_m
    return far or rotation_angle(apart) > tolerated_rad
