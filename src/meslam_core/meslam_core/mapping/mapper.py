"""The mapping side of the pipeline: regions and keyframes, and their training beside tracking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from meslam_core.config import MappingConfig, MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.field import field_device, make_field
from meslam_core.frame import RgbdFrame
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.loop.relocalisation import Relocaliser
from meslam_core.mapping.frame_training import FrameTraining
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframe_chain import KeyframeChain
from meslam_core.mapping.keyframe_policy import REVISITED_SLACK, KeyframePolicy
from meslam_core.mapping.keyframe_registration import NewKeyframe
from meslam_core.mapping.keyframes import KeyframeStore, Rays, rays_at
from meslam_core.mapping.refinement import REFINING_STEPS, Refinement
from meslam_core.mapping.training_worker import Training
from meslam_core.odometry import OdometryEstimate
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.observed_mask import ObservedMask
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose
from meslam_core.tracking.map_uncertainty import MapUncertainty
from meslam_core.tracking.pixels import TrustedPixels

CURRENT_FRAME_RAYS = 4096


@dataclass(frozen=True)
class SampledFrame:
    """A frame from which rays are drawn.

    Attributes:
        frame: its images.
        pixels: those whose depth is trusted.
        generator: of the choice.
    """

    frame: RgbdFrame
    pixels: TrustedPixels
    generator: np.random.Generator

    def rays(self, count: int) -> Rays:
        """Up to `count` rays, camera frame."""
        return rays_at(self.frame, *self.pixels.choose(count, self.generator))


class Mapper:
    """Trains the map with tracked frames, in a thread of its own.

    While a training runs, regions and keyframes belong to it; `show` then has what they were when
    it began.

    Args:
        config: all numbers.
        seed: of the networks and of what is drawn for training.
        frames_wait: whether frames wait to be tracked, and training is to give way.
        show: takes a copy of the working region whenever the map has changed and no training runs;
            the keyframes' poses may be read then.
        continuation: a stored map to go on with, instead of an empty one.

    Attributes:
        keyframes: of all regions.
        optimizer: trains them.
        atlas: the regions; None before the first frame.
        remembered: so many keyframes stand for an earlier session's.
        reference: number of the keyframe whose place the latest frame is tied to: the newest one,
            or one from long ago where the camera has come back to it.

    Raises:
        MapError: when the map cannot be continued.
    """

    def __init__(
        self,
        config: MeslamConfig,
        seed: int,
        frames_wait: Callable[[], bool],
        show: Callable[[Region], None],
        continuation: Continuation | None = None,
    ) -> None:
        self._config = config
        self._seed = seed
        self._trains = continuation is None or continuation.train
        self._frames_wait = frames_wait
        self._show = show
        self._scratch = ScratchFile(config.runtime.work_dir)
        kept = config.keyframes
        # One network needs all its keyframes, always.
        rays_rest = None if config.regions.single else self._scratch
        device = field_device(config.field)
        self.keyframes = KeyframeStore(kept.rays, device, kept.ray_budget, seed, rays_rest)
        self.optimizer = JointOptimizer(self.keyframes, config.mapping, seed)
        self.atlas: RegionAtlas | None = None
        self._chain = KeyframeChain(self.keyframes)
        self._policy = KeyframePolicy(config.keyframes, config.field)
        self._uncertainty = MapUncertainty()
        self._training: FrameTraining | None = None
        self._refinement: Refinement | None = None
        # What tracking sees of the working region while training changes the original.
        self._viewed_field = make_field(config.field, seed)
        self.remembered = self.reference = 0
        if continuation is not None:
            self._map_into(continuation.atlas(config, self.keyframes, seed, self._scratch))
            self.remembered = len(self.keyframes)
            self.reference = self.remembered - 1
            self._uncertainty.update(self.keyframes)

    @property
    def trains(self) -> bool:
        """Whether frames train the map; a stored one may only be looked at."""
        return self._trains

    @property
    def recogniser(self) -> RegionRecogniser | None:
        """Asks regions that were come back to, where loops are closed."""
        return self._training.recogniser if self._training else None

    @property
    def relocaliser(self) -> Relocaliser:
        """Finds a lost camera; the images of keyframes belong to a training that runs."""
        assert self._training is not None, "there is no map yet"
        return self._training.relocaliser

    @property
    def refining_steps(self) -> int:
        """How many steps a refinement of the whole map takes."""
        if not self._trains:
            return 0
        refinement = self._refinement
        return refinement.steps if refinement else self._config.mapping.final_iterations

    def begin_at(self, position: NDArray[np.floating]) -> None:
        """Let the region of a stored map work that a position (3,), map frame [m], is in."""
        assert self.atlas is not None, "only a stored map has places to begin at"
        self.atlas.take_over(self.atlas.grid, list(self.atlas.regions.values()), position)
        self.look()

    def enter(self, region: Region) -> None:
        """Let the region work in which a lost camera was found."""
        assert self.atlas is not None
        self.atlas.enter(region)
        self.look()

    def discard(self, since: int) -> None:
        """Forget what keyframes from a number on show: their poses proved to be wrong."""
        assert self.atlas is not None
        self.relocaliser.forget(since)
        self.atlas.discard(since)

    def pass_by(self, odometry: OdometryEstimate | None, lost: bool) -> None:
        """Take up a frame's odometry; a lost camera breaks the chain of keyframes."""
        self._chain.pass_by(odometry)
        if lost:
            self._chain.cut()

    def begin(
        self, sampled: SampledFrame, T_map_camera: Pose, odometry: OdometryEstimate | None
    ) -> None:
        """The first frame defines the map frame and trains the first region from nothing."""
        position = T_map_camera[:3, 3]
        training = self._map_into(
            RegionAtlas(self._config, position, self.keyframes, self._seed, self._scratch)
        )
        self._add_keyframe(sampled, T_map_camera, odometry)
        training.start_first()

    def train(
        self,
        sampled: SampledFrame,
        T_map_camera: Pose,
        odometry: OdometryEstimate | None,
        lags: bool = False,
    ) -> bool:
        """Update regions and keyframes for a tracked frame and train; whether it is a keyframe.

        Args:
            sampled: the frame.
            T_map_camera: (4, 4) its pose.
            odometry: of it, where there is some.
            lags: whether the map lags behind what is seen, so that training does not give way.
        """
        assert self.atlas is not None
        assert self._training is not None
        if not self._trains:
            if self.atlas.follow(T_map_camera[:3, 3]):
                self.look()
            return False
        self.atlas.update(T_map_camera[:3, 3])
        revisited = self._revisited(sampled.frame, T_map_camera)
        is_keyframe = self._policy.is_keyframe(
            self.atlas.working,
            self.keyframes,
            len(self.keyframes) - 1 if revisited is None else revisited,
            sampled.frame.camera,
            T_map_camera,
            sampled.rays(self._policy.PIXELS),
            1.0 if revisited is None else REVISITED_SLACK,
        )
        keyframe = self._add_keyframe(sampled, T_map_camera, odometry) if is_keyframe else None
        revisit = None
        if revisited is not None and not is_keyframe:
            self.reference, revisit = revisited, (revisited, sampled.frame)
            # Odometry over all that is revisited would tie two keyframes with the drift of it.
            self._chain.cut()
        current = sampled.rays(CURRENT_FRAME_RAYS)
        self.look()
        self._training.start(
            sampled.frame.stamp_ns, current, T_map_camera, keyframe, revisit, lags=lags
        )
        return is_keyframe

    def _revisited(self, frame: RgbdFrame, T_map_camera: Pose) -> int | None:
        """A keyframe from long ago that shows what a frame shows, as far as is known."""
        assert self.atlas is not None
        assert self._training is not None
        if not self._training.recognises:
            return None
        working = self.atlas.working
        return self._policy.revisited(working, self.keyframes, frame.stamp_ns, T_map_camera)

    def wait(self) -> Training:
        """Wait for the training that runs, and show what it did; what the latest one did."""
        if self._training is None:
            return Training()
        if self._training.wait():
            self.look()
            self._uncertainty.update(self.keyframes)
        return self._training.latest

    def pause(self) -> None:
        """Wait for the training that runs, without showing yet what it did."""
        if self._training is not None:
            self._training.settle()

    def look(self) -> None:
        """Show the map as it is now; no training runs."""
        if self.atlas is None:
            return
        working = self.atlas.working
        self._viewed_field.load_flat(working.field.average())
        mask = working.mask
        if working.unmarked:
            # Training is going to change the mask.
            mask = ObservedMask.from_flags(mask.flags.copy(), mask.voxel_m)
        self._show(working.viewed(self._viewed_field, mask))

    def covariance(self, T_map_camera: Pose, reference: int) -> NDArray[np.float64]:
        """Covariance (6, 6) of the map's place where a pose was found by a keyframe."""
        return self._uncertainty.covariance(T_map_camera[:3, 3], reference)

    def refine(self, steps: int, progress: float = 0.0) -> None:
        """Train on what was seen for `steps` steps, over all regions; keyframe poses follow.

        Args:
            steps: number of Adam steps.
            progress: share of the whole refinement that is done, in [0, 1]; the learning rate
                falls with it, and with it the noise that training leaves in the map.
        """
        self.wait()
        if self._refinement is not None:
            self._refinement.train(steps, progress)
            self.look()

    def finish(self, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Refine once more over everything seen; then mark the observed space anew.

        Args:
            progress: called with the steps that are done and their total.
        """
        total = self.refining_steps
        for done in range(0, total, REFINING_STEPS):
            progress(done, total)
            self.refine(min(REFINING_STEPS, total - done), done / total)
        self.settle()

    def settle(self) -> None:
        """Mark the observed space anew where the refined keyframes saw it."""
        self.wait()
        if self._refinement is not None and self._trains:
            self._refinement.rebuild_masks()
            self.look()

    def change_steps(self, mapping: MappingConfig) -> None:
        """From the next training on take the numbers of steps from another configuration."""
        changed = replace(
            self._config.mapping,
            iterations=mapping.iterations,
            min_iterations=mapping.min_iterations,
            keyframe_iterations=mapping.keyframe_iterations,
            final_iterations=mapping.final_iterations,
        )
        self._config = replace(self._config, mapping=changed)
        self.optimizer.config = changed

    def _map_into(self, atlas: RegionAtlas) -> FrameTraining:
        """From now on these regions are trained and refined."""
        self.atlas = atlas
        self._refinement = Refinement(atlas, self.optimizer)
        self._training = FrameTraining(
            self._config, atlas, self.optimizer, self._scratch, self._frames_wait
        )
        return self._training

    def _add_keyframe(
        self, sampled: SampledFrame, pose: Pose, odometry: OdometryEstimate | None
    ) -> NewKeyframe:
        assert self.atlas is not None
        rays = sampled.rays(self._config.keyframes.rays)
        number = self._chain.add(sampled.frame.stamp_ns, pose, rays, odometry)
        self.reference = number
        self.atlas.add_keyframe(number)
        return number, sampled.frame, rays
