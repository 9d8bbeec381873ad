"""One run of MeSLAM or of a peer over a recording, in a process of its own, and its errors."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray
from peers import pose_graph_slam, tsdf_slam
from simulated import program

from meslam_core.command_output import TRACKING_LOST
from meslam_core.config import PRESETS
from meslam_core.errors import EvaluationError
from meslam_core.evaluation.trajectory_error import AbsoluteError, absolute_error
from meslam_core.recordings import open_recording
from meslam_core.results import ONLINE_TRAJECTORY, REPORT, TRAJECTORY
from meslam_core.trajectory import Trajectory, read_tum

HERE = Path(__file__).resolve().parent
# The peers may have settings of their own for a camera; MeSLAM has the same for all.
PEER_SETTINGS: dict[str, dict[str, tuple[str, ...]]] = {
    "tsdf": tsdf_slam.SETTINGS,
    "pose_graph": pose_graph_slam.SETTINGS,
}


@dataclass(frozen=True)
class Sequence:
    """A recording and what is known of it.

    Attributes:
        name: for people.
        recording: file or folder.
        truth: true poses (TUM format).
        lever_arm: the true poses are another sensor's on the same mount; its place is fitted.
        surface: the exact surface in the truth's frame, where it is known.
    """

    name: str
    recording: Path
    truth: Path
    lever_arm: bool = False
    surface: Path | None = None

    def error_of(self, trajectory: Trajectory) -> AbsoluteError:
        """ATE; without a lever arm where the trajectory, lost early, turns too little for it."""
        truth = read_tum(self.truth)
        try:
            return absolute_error(trajectory, truth, hand_eye=self.lever_arm)
        except EvaluationError:
            return absolute_error(trajectory, truth)


@dataclass(frozen=True)
class SlamRun:
    """One run of one method.

    Attributes:
        sequence: what it runs over.
        method: a preset of MeSLAM, `meslam` for the default one, or a peer.
        seed: of MeSLAM; the number of the repetition for the peers, which have no random choices
            but sum in different orders on several threads.
        frames: `A:B:STEP`.
        cores: that may be used.
        out: folder of the results.
    """

    sequence: Sequence
    method: str
    seed: int
    frames: str
    cores: int
    out: Path

    @property
    def is_peer(self) -> bool:
        """Whether it is not MeSLAM."""
        return self.method in PEER_SETTINGS

    @property
    def done(self) -> bool:
        """Whether its results are there."""
        return (self.out / REPORT).exists()

    @property
    def report(self) -> Mapping[str, Any]:
        """What the run said about itself."""
        read: dict[str, Any] = json.loads((self.out / REPORT).read_text())
        return read

    @property
    def chosen(self) -> slice:
        """The frames."""
        return slice(*(int(part) if part else None for part in self.frames.split(":")))

    @cached_property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Of the frames [ns]."""
        with closing(open_recording(self.sequence.recording)) as recording:
            return np.asarray(recording.stamps_ns)[self.chosen]

    @property
    def command(self) -> list[str]:
        """What runs it, in the folder of this file."""
        sequence = self.sequence
        common = [str(sequence.recording), "--out", str(self.out), "--frames", self.frames]
        if self.is_peer:
            best = PEER_SETTINGS[self.method].get(sequence.name, ())
            settings = [word for setting in best for word in ("--set", setting)]
            return [sys.executable, "-m", "peers", self.method, *common, *settings]
        preset = ["--preset", self.method] if self.method in PRESETS else []
        lever_arm = ["--lever-arm"] if sequence.lever_arm else []
        truth = ["--truth", str(sequence.truth), *lever_arm]
        return [program(), "run", *common, *truth, "--seed", str(self.seed), *preset]

    def run(self, log: TextIO | None = None) -> None:
        """Run it on its share of the cores; a camera that is lost is a result.

        Raises:
            subprocess.CalledProcessError: when there are no results.
        """
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        environment = dict(os.environ)
        # MeSLAM divides its cores itself.
        environment.pop("OMP_NUM_THREADS", None)
        if self.is_peer:
            environment["OMP_NUM_THREADS"] = str(self.cores)

        def confine() -> None:
            if hasattr(os, "sched_setaffinity"):
                os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: self.cores])

        ended = subprocess.run(
            self.command,
            cwd=HERE,
            env=environment,
            stdout=log,
            stderr=log,
            preexec_fn=confine,
            check=False,
        )
        if ended.returncode != TRACKING_LOST:
            ended.check_returncode()

    def trajectory(self, *, online: bool = False) -> Trajectory:
        """Poses of the tracked frames: refined, or as each was known when it was done."""
        return read_tum(self.out / (ONLINE_TRAJECTORY if online else TRAJECTORY))

    def of_all_frames(self, *, online: bool = False) -> Trajectory:
        """Poses of all frames; one that was not tracked has the last pose before it."""
        return held(self.trajectory(online=online), self.stamps_ns)


def held(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """Poses at all stamps of the frames; one that was not tracked has the last pose before it."""
    last = np.searchsorted(trajectory.stamps_ns, stamps_ns, side="right") - 1
    return Trajectory(stamps_ns, trajectory.poses[np.maximum(last, 0)])
