"""What ties new keyframes to older ones, and recognises the places of before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from meslam_core.camera import PinholeCamera
from meslam_core.config import MeslamConfig
from meslam_core.frame import RgbdFrame
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.loop.relocalisation import Relocaliser
from meslam_core.mapping.covisibility import CovisibilityLinker
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, inverse

# A new keyframe: its number, its images and its sample of rays, camera frame.
NewKeyframe = tuple[int, RgbdFrame, Rays]
# A frame that comes back to an old keyframe: that one's number, and the frame's images.
Revisit = tuple[int, RgbdFrame]
# While frames wait, a keyframe is registered with so many older ones at most, and so many keyframes
# may be behind with that; then the oldest goes without.
LEAST_ATTEMPTS = 3
KEYFRAMES_BEHIND = 8


class KeyframeRegistration:
    """Registers new keyframes with older ones, as far as frames leave time for it.

    Args:
        config: what is registered.
        atlas: its doubtful regions are asked whether they know the view.
        scratch: where the keyframes' images lie.
        frames_wait: whether frames wait to be tracked. While they do, registrations are spread
            over the frames to come.

    Attributes:
        recogniser: asks regions that woke, where loops are closed.
        relocaliser: finds a lost camera, while no training runs.
        recognises: whether the latest frame that seemed to revisit a keyframe shows that place.
    """

    def __init__(
        self,
        config: MeslamConfig,
        atlas: RegionAtlas,
        scratch: ScratchFile,
        frames_wait: Callable[[], bool],
    ) -> None:
        self._atlas = atlas
        self._keyframes = atlas.keyframes
        self._frames_wait = frames_wait
        self._behind: deque[Iterator[None]] = deque(maxlen=KEYFRAMES_BEHIND)
        self._asking: Iterator[None] | None = None
        self._linker: CovisibilityLinker | None = None
        self.recogniser: RegionRecogniser | None = None
        self.recognises = True
        if config.keyframes.links:
            self._linker = CovisibilityLinker(self._keyframes, config, scratch)
            if config.regions.close_loops:
                self.recogniser = RegionRecogniser(atlas, self._linker)
        self.relocaliser = Relocaliser(config.relocalisation, config.tracking, atlas, self._linker)

    def add(self, keyframe: NewKeyframe) -> None:
        """Take a new keyframe, to be registered when `proceed` comes to it."""
        self.recognises = True
        if self._linker is None:
            return
        number, frame, rays = keyframe
        self._linker.keep(number, frame)
        self.relocaliser.remember(number)
        doubtful = self._atlas.doubtful
        if doubtful and self._asking is None and self.recogniser is not None:
            # One after the other: the first may be where no older keyframe was.
            region = doubtful[number % len(doubtful)]
            self._asking = self.recogniser.ask(region, number, frame.camera, rays)
        self._behind.append(self._links(self._linker, number, frame.camera, rays))

    def revisit(self, revisit: Revisit, T_map_camera: Pose) -> None:
        """Ask whether a frame shows the place that it comes back to, where that is in doubt.

        Regions that know the place are then no longer in doubt. Where it does not show it, the
        next frame may become a keyframe, which the recogniser asks for.

        Args:
            revisit: the frame, and the keyframe.
            T_map_camera: (4, 4) where it is believed to be.
        """
        self.recognises = True
        if self.recogniser is None or not self._atlas.doubtful:
            return
        keyframe, frame = revisit
        self.recognises = self.recogniser.confirm(keyframe, frame, T_map_camera)

    def proceed(self, least: int = 1) -> Pose:
        """Make the registrations that are due.

        Args:
            least: so many are made although frames wait.

        Returns:
            (4, 4) how that moved the newest keyframe, map frame: the identity, unless a place was
            recognised and the path to here corrected.
        """
        corrections = self._corrections
        newest = len(self._keyframes) - 1
        before = self._keyframes.pose(newest)
        done = 0
        while not (done >= least and self._frames_wait()) and self._step():
            done += 1
        if self._corrections == corrections:
            return np.eye(4)
        return self._keyframes.pose(newest) @ inverse(before)

    @property
    def _corrections(self) -> int:
        return self.recogniser.corrections if self.recogniser else 0

    def _step(self) -> bool:
        """Make one registration; whether there was one to make."""
        if self._asking is not None:
            if next(self._asking, self) is not self:
                return True
            self._asking = None
        while self._behind:
            if next(self._behind[0], self) is not self:
                return True
            self._behind.popleft()
        return False

    def _links(
        self, linker: CovisibilityLinker, number: int, camera: PinholeCamera, rays: Rays
    ) -> Iterator[None]:
        """Link a keyframe with older ones, a registration at a time."""
        for attempt, link in enumerate(linker.link(number, camera, rays), 1):
            if link is not None:
                self._keyframes.add_link(link.first, link.second, link.T_first_second)
            yield
            if attempt >= LEAST_ATTEMPTS and self._frames_wait():
                return
