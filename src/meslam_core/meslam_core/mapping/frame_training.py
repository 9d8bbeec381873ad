"""What training does with each frame, beside the tracking of the next one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

from meslam_core.config import MeslamConfig
from meslam_core.loop.recognition import RegionRecogniser
from meslam_core.loop.relocalisation import Relocaliser
from meslam_core.mapping.joint_optimizer import JointOptimizer
from meslam_core.mapping.keyframe_registration import KeyframeRegistration, NewKeyframe, Revisit
from meslam_core.mapping.keyframes import Rays
from meslam_core.mapping.training_worker import Training, TrainingWorker
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.region import Region
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose

# Of the first frame's steps so many come before the next frame may be tracked; the following
# frames make up for the rest, so many steps each.
FIRST_STEPS_SHARE = 0.4
MADE_UP_A_FRAME = 40
# `mapping.min_iterations` are of frames that follow each other within so long [s]; one that comes
# later stands for those that were passed over, and what it shows anew takes their steps, too.
FRAME_PERIOD_S = 1.0 / 15.0
# A region that knows its box is trained beside another one at this share of the
# learning rate, which evens out what the full rate leaves and forgets nothing for what lies ahead.
SETTLED_RATE_FACTOR = 0.25
NANOSECONDS = 1e-9


class FrameTraining:
    """Trains the regions about the camera with one frame after the other, in a thread of its own.

    From `start` to `wait` regions and keyframes belong to that thread.

    Args:
        config: of mapping, and of what links keyframes.
        atlas: tells which regions are trained.
        optimizer: trains them.
        scratch: where the keyframes' images lie.
        frames_wait: whether frames wait to be tracked. While they do, training gives way: it ends
            after `mapping.min_iterations` steps, or more where frames were skipped.

    Attributes:
        latest: what the latest training did that was waited for.
    """

    def __init__(
        self,
        config: MeslamConfig,
        atlas: RegionAtlas,
        optimizer: JointOptimizer,
        scratch: ScratchFile,
        frames_wait: Callable[[], bool],
    ) -> None:
        self.latest = Training()
        self._atlas = atlas
        self._optimizer = optimizer
        self._frames_wait = frames_wait
        self._worker = TrainingWorker()
        self._trained: list[Region] = []
        self._steps_owed = 0
        self._trained_ns: int | None = None
        self._turn = 0
        self._registration = KeyframeRegistration(config, atlas, scratch, frames_wait)

    @property
    def recogniser(self) -> RegionRecogniser | None:
        """Asks regions that woke, where loops are closed."""
        return self._registration.recogniser

    @property
    def relocaliser(self) -> Relocaliser:
        """Finds a lost camera, while no training runs."""
        return self._registration.relocaliser

    def start_first(self) -> None:
        """Begin to train the first region from nothing, with the first keyframe."""
        self._trained = [self._atlas.working]
        self._steps_owed = self._optimizer.config.first_iterations
        self._worker.start(self._train_first)

    @property
    def recognises(self) -> bool:
        """Whether the latest frame that seemed to revisit a keyframe shows that place."""
        return self._registration.recognises

    def start(
        self,
        stamp_ns: int,
        current: Rays,
        T_map_current: Pose,
        keyframe: NewKeyframe | None,
        revisit: Revisit | None = None,
        *,
        lags: bool = False,
    ) -> None:
        """Begin to train with a frame.

        Args:
            stamp_ns: of its image [ns].
            current: rays of the frame, camera frame.
            T_map_current: (4, 4) its pose.
            keyframe: what it is as a keyframe, where it is one.
            revisit: where it comes back to an old keyframe.
            lags: whether the map lags behind what is seen, so that training does not give way.
        """
        config = self._optimizer.config
        steps = config.iterations if keyframe is None else config.keyframe_iterations
        frames = self._frames_since(stamp_ns)
        least = steps if lags else min(steps, config.min_iterations * frames)
        steps += min(self._steps_owed, MADE_UP_A_FRAME)
        self._trained = self._next_to_train()
        self._worker.start(
            partial(
                self._train, self._trained, least, steps, current, T_map_current, keyframe, revisit
            )
        )

    def wait(self) -> bool:
        """Wait for the training that runs; whether one did. Raises what the training raised."""
        trained = self._worker.wait()
        if trained is None:
            return False
        for region in self._trained:
            region.version += 1
        if self._steps_owed:
            self._steps_owed = max(0, self._steps_owed - trained.losses.steps)
        self.latest = trained
        return True

    def settle(self) -> None:
        """Wait until the training that runs has ended, without taking up what it did."""
        self._worker.settle()

    def _frames_since(self, stamp_ns: int) -> int:
        """How many frames this one stands for."""
        before, self._trained_ns = self._trained_ns, stamp_ns
        if before is None:
            return 1
        return max(1, round((stamp_ns - before) * NANOSECONDS / FRAME_PERIOD_S))

    def _next_to_train(self) -> list[Region]:
        """The working region, and in turn one of the others that contain the camera.

        So a frame costs the same at a corner, where eight regions meet, as between two.
        """
        others = [region for region in self._atlas.training if region.confirmed]
        self._turn += 1
        self._atlas.working.has_worked = True
        return [self._atlas.working, *(others[self._turn % len(others)] for _ in others[:1])]

    def _train(
        self,
        regions: list[Region],
        least: int,
        steps: int,
        current: Rays,
        pose: Pose,
        keyframe: NewKeyframe | None,
        revisit: Revisit | None,
    ) -> Training:
        """Train the working region, which comes first, and the other one half as long.

        At least `least` steps are taken, and as many as `steps` where no frame waits.
        """
        started = time.perf_counter()
        # While frames wait, either a view is marked or a registration made.
        registers = self._turn % 2
        self._atlas.settle(marks=not (registers and self._frames_wait()))
        if keyframe is not None:
            self._registration.add(keyframe)
            pose = self._registration.proceed(registers) @ pose
        if revisit is not None:
            self._registration.revisit(revisit, pose)
        losses = self._optimizer.train(
            regions[0], steps, current, pose, enough=partial(self._may_end, least)
        )
        for region in regions[1:]:
            self._optimizer.train(
                region,
                steps // 2,
                current,
                pose,
                refine_poses=False,
                rate_factor=SETTLED_RATE_FACTOR if region.settled else 1.0,
                enough=partial(self._may_end, least // 2),
            )
        if keyframe is None:
            self._registration.proceed(registers)
        return Training(losses, (time.perf_counter() - started) * 1e3)

    def _train_first(self) -> Training:
        started = time.perf_counter()
        least = math.ceil(FIRST_STEPS_SHARE * self._steps_owed)
        losses = self._optimizer.train(
            self._atlas.working,
            self._steps_owed,
            refine_poses=False,
            enough=partial(self._may_end, least),
        )
        return Training(losses, (time.perf_counter() - started) * 1e3)

    def _may_end(self, least: int, done: int) -> bool:
        return done >= least and self._frames_wait()
