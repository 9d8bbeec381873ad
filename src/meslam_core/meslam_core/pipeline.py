"""A recording from its first frame to its trajectory, map and report."""

from __future__ import annotations

import logging
import threading
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from meslam_core.config import MeslamConfig
from meslam_core.continuation import Continuation
from meslam_core.errors import EvaluationError, FrameError, RecordingError
from meslam_core.evaluation.covariance import covariance_entries
from meslam_core.evaluation.report import truth_entries
from meslam_core.frame_log import FRAMES
from meslam_core.frame_recorder import FrameRecorder
from meslam_core.interruption import stop_request
from meslam_core.odometry import GivenOdometry, make_odometry
from meslam_core.odometry_worker import OdometryWorker
from meslam_core.pacing import PacedFrames
from meslam_core.pose_covariance import PoseCovariances, write_covariances
from meslam_core.recordings.recording import Recording
from meslam_core.results import COVARIANCES, MAP, ONLINE_TRAJECTORY, TRAJECTORY, ResultFolder
from meslam_core.run_report import Tally, map_entries, run_environment
from meslam_core.session_map import write_map
from meslam_core.slam import FrameResult, Slam, TrackingState
from meslam_core.threads import limit_threads
from meslam_core.trajectory import Trajectory, read_tum, write_tum

logger = logging.getLogger(__name__)


class RunProgress(Protocol):
    """Is told how a run goes on."""

    def started(self, frames: int) -> None:
        """`frames` frames are going to be offered."""
        ...

    def processed(self, offered: int, result: FrameResult) -> None:
        """One more frame is done, the last of `offered` ones."""
        ...

    def stage(self, name: str) -> None:
        """Another stage begins: "refining" or "writing"."""
        ...

    def refined(self, done: int, total: int) -> None:
        """So many of the steps of refining are done."""
        ...


class Silent:
    """Progress that nobody follows."""

    def started(self, frames: int) -> None:
        """Nothing."""

    def processed(self, offered: int, result: FrameResult) -> None:
        """Nothing."""

    def stage(self, name: str) -> None:
        """Nothing."""

    def refined(self, done: int, total: int) -> None:
        """Nothing."""


@dataclass(frozen=True)
class RunOptions:
    """How a recording is run.

    Attributes:
        frames: which of the recording's pairs to use, as in a list; nothing negative.
        realtime: offer frames at the recording's pace and skip those that come while an earlier
            one is in work (see `PacedFrames`).
        truth: poses in TUM format to compare with.
        hand_eye: the truth is the pose of another sensor on the same mount; find its place too.
        odometry: poses of the camera in TUM format, in any frame, that take the place of the
            built-in odometry.
        continuation: a stored map to go on with.
        seed: of every random choice.
        command: that asked for the run, for the report.
    """

    frames: slice = field(default_factory=lambda: slice(None))
    realtime: bool = False
    truth: Path | None = None
    hand_eye: bool = False
    odometry: Path | None = None
    continuation: Continuation | None = None
    seed: int = 0
    command: str = ""

    def entries(self, recording: Path) -> dict[str, Any]:
        """What the report says of them, to find again what the run was made of."""
        return {
            "recording_path": str(recording.absolute()),
            "frame_range": [self.frames.start or 0, self.frames.stop, self.frames.step or 1],
            "truth": None if self.truth is None else str(self.truth.absolute()),
            "lever_arm": self.hand_eye,
            "command": self.command or None,
        }


@dataclass(frozen=True)
class RunOutcome:
    """What became of a run.

    Attributes:
        report: the content of `report.json`.
        broke_off: why the recording ended early; empty when it did not.
        interrupted: whether the user ended the run.
        lost: why tracking was lost at the end, or never started; empty where it was not.
        not_evaluated: why the given truth could not be compared with; empty when it was.
    """

    report: dict[str, Any]
    broke_off: str
    interrupted: bool
    lost: str
    not_evaluated: str


def run(
    recording: Recording,
    config: MeslamConfig,
    out_dir: Path,
    options: RunOptions | None = None,
    progress: RunProgress | None = None,
) -> RunOutcome:
    """Track and map a recording, and write what came of it.

    Writes `trajectory.txt` (refined) and `trajectory_online.txt` (TUM format, T_map_camera, one
    line a tracked frame), `covariance_online.txt` (see `write_covariances`), `frames.csv` (see
    `FrameEntry`), `map.meslam/` and `report.json` into `out_dir`. A recording that breaks off, or
    a user who interrupts (SIGINT, SIGTERM), still leaves the results of the frames before; after
    any other error nothing of this run is left.

    Args:
        recording: open; it is not closed.
        config: all numbers.
        out_dir: made where it does not exist; results of an earlier run are replaced.
        options: which frames, at which pace, compared with what.
        progress: is told how the run goes on.

    Raises:
        OutputError: when `out_dir` cannot be written; known before the first frame.
        EvaluationError: when the truth or the odometry cannot be read; known before the first
            frame.
        RecordingError, FrameError: when not a single frame can be read.
    """
    options, progress = options or RunOptions(), progress or Silent()
    limit_threads(config.runtime.threads)
    truth = None if options.truth is None else read_tum(options.truth)
    odometry = None if options.odometry is None else read_tum(options.odometry)
    with ResultFolder(out_dir) as results:
        with FrameRecorder(results.incomplete(FRAMES), config.map.codec) as recorder:
            loop = _Loop(recording, config, options, odometry, progress, recorder)
            loop.run()
        slam = loop.slam
        progress.stage("writing")
        refined = loop.tally.tracked(slam.trajectory())
        online = loop.tally.tracked(slam.online_trajectory())
        write_tum(results.incomplete(TRAJECTORY), refined)
        write_tum(results.incomplete(ONLINE_TRAJECTORY), online)
        covariances = loop.tally.covariances()
        write_covariances(results.incomplete(COVARIANCES), covariances)
        report = loop.report()
        map_id = options.continuation.map_id if options.continuation else None
        report["map_bytes"] = write_map(
            slam, loop.tally.last_stamp_ns, results.incomplete(MAP), map_id
        )
        not_evaluated = ""
        if truth is not None:
            not_evaluated = _evaluate(refined, online, covariances, truth, options.hand_eye, report)
        report.update(run_environment())
        results.write_report(report)
        results.publish()
    tracking = slam.state in (TrackingState.OK, TrackingState.DEGRADED)
    lost = "" if tracking else loop.tally.reason or f"state {slam.state.name}"
    return RunOutcome(report, loop.broke_off, loop.interrupted, lost, not_evaluated)


class _Loop:
    """The loop over the frames and what it finds out.

    Attributes:
        tally: of the processed frames.
        broke_off: why the recording ended early; empty when it did not.
        interrupted: whether the user ended the loop.
        skipped: frames passed over to keep the recording's pace.
        online_s: time from before the first frame is read until the last one is mapped [s].
        wall_s: the same until the map is refined [s].
        slam: what the frames are fed to.
    """

    def __init__(
        self,
        recording: Recording,
        config: MeslamConfig,
        options: RunOptions,
        odometry: Trajectory | None,
        progress: RunProgress,
        recorder: FrameRecorder,
    ) -> None:
        self.tally = Tally()
        self.broke_off = ""
        self.interrupted = False
        self.skipped = 0
        self.online_s = 0.0
        self.wall_s = 0.0
        self.slam = Slam(
            config,
            options.seed,
            frames_wait=self._frames_wait,
            continuation=options.continuation,
        )
        config = self.slam.config
        self._config = config
        self._recording = recording
        self._worker: OdometryWorker | None = None
        self._options = options
        self._odometry = odometry
        self._progress = progress
        self._recorder = recorder

    def run(self) -> None:
        """Feed the frames, then refine the map unless the user is in a hurry."""
        started = time.perf_counter()
        with stop_request() as stop:
            try:
                self._feed(stop)
            except (RecordingError, FrameError) as error:
                if not self.tally.frames:
                    raise
                self.broke_off = str(error)
            if not self.tally.frames:
                raise RecordingError(
                    f"{self._recording.name}: the chosen frames are none of its "
                    f"{len(self._recording)} frames; choose others"
                )
            self.online_s = time.perf_counter() - started
            if not self.interrupted:
                self._progress.stage("refining")
                self.slam.finish(self._progress.refined)
        self.wall_s = time.perf_counter() - started

    def _feed(self, stop: threading.Event) -> None:
        chosen, config = self._options.frames, self._config
        self._progress.started(len(range(*chosen.indices(len(self._recording)))))
        odometry = (
            make_odometry(config.odometry, config.sensor)
            if self._odometry is None
            else GivenOdometry(self._odometry, config.odometry)
        )
        frames = self._recording.frames(chosen.start or 0, chosen.stop, chosen.step or 1)
        paced = PacedFrames(frames) if self._options.realtime else None
        self._worker = OdometryWorker(paced or frames, odometry, config.runtime.queue)
        with closing(iter(self._worker)) as ready:
            for timed in ready:
                self.slam.track(timed.frame, timed.odometry)
                late_ms = None
                if paced is not None:
                    late_ms = paced.lateness_s(timed.frame.stamp_ns) * 1e3
                    self.tally.lateness_ms.append(late_ms)
                    self.skipped = paced.skipped
                result = self.slam.map()
                if not self.tally.frames:
                    self._doubt_start(result)
                self.tally.add(result, timed.reading_ms, timed.odometry_ms)
                self._recorder.add(self.slam, result, timed, late_ms, self.skipped)
                self._progress.processed(self.tally.frames + self.skipped, result)
                if stop.is_set():
                    self.interrupted = True
                    return
        self.slam.wait()

    def _doubt_start(self, first: FrameResult) -> None:
        """Warn where the first image shows nothing of the map that is gone on with."""
        if self._options.continuation is not None and first.reason:
            logger.warning(
                "the stored map does not confirm where the first image was taken: %s; if the start "
                "pose is wrong, what is mapped now does not fit the rest",
                first.reason,
            )

    def _frames_wait(self) -> bool:
        """Whether mapping is to give way: only at the recording's pace can it be too slow."""
        return self._options.realtime and self._worker is not None and self._worker.waiting

    def report(self) -> dict[str, Any]:
        """The entries of `report.json` that the loop knows."""
        return {
            **self.tally.entries(),
            **map_entries(self.slam),
            "frames_skipped": self.skipped,
            "online_s": self.online_s,
            "wall_s": self.wall_s,
            "fps": self.tally.frames / self.online_s,
            "final_state": self.slam.state.name,
            "broke_off": self.broke_off or None,
            "interrupted": self.interrupted,
            "recording": self._recording.name,
            **self._options.entries(self._recording.path),
            "camera": self._recording.camera.to_dict(),
            "topics": self._recording.topics,
            "seed": self._options.seed,
            "realtime": self._options.realtime,
            "config": self._config.to_mapping(),
        }


def _evaluate(
    refined: Trajectory,
    online: Trajectory,
    covariances: PoseCovariances,
    truth: Trajectory,
    hand_eye: bool,
    report: dict[str, Any],
) -> str:
    """Add the errors against the truth to the report; why not, where they cannot be known."""
    try:
        report.update(truth_entries(refined, online, truth, hand_eye=hand_eye))
        report.update(covariance_entries(online, covariances.matrices, truth, hand_eye=hand_eye))
    except EvaluationError as error:
        return str(error)
    return ""
