"""What every peer offers, and how one is run over a recording."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from meslam_core.frame import RgbdFrame
from meslam_core.recordings import Recording
from meslam_core.results import ONLINE_TRAJECTORY, REPORT, TRAJECTORY
from meslam_core.se3 import Pose, orthonormalized
from meslam_core.trajectory import Trajectory, write_tum


class Peer(Protocol):
    """A SLAM system that is fed frame by frame."""

    def process(self, frame: RgbdFrame) -> Pose | None:
        """T_map_camera (4, 4) of the next frame as known now; None where tracking fails."""
        ...

    def finish(self) -> list[Pose]:
        """T_map_camera (4, 4) of all tracked frames, with everything that is known at the end."""
        ...


@dataclass(frozen=True)
class PeerRun:
    """What a peer made of a recording.

    Attributes:
        online: T_map_camera of the tracked frames as known when each was done.
        refined: the same after the end.
        frames: number of frames offered.
        wall_s: time from before the first frame is read until the poses are refined [s].
    """

    online: Trajectory
    refined: Trajectory
    frames: int
    wall_s: float

    def write(self, out: Path, parameters: Mapping[str, Any]) -> None:
        """Write both trajectories and a report with the names `meslam run` uses."""
        out.mkdir(parents=True, exist_ok=True)
        write_tum(out / TRAJECTORY, self.refined)
        write_tum(out / ONLINE_TRAJECTORY, self.online)
        report = {
            "frames": self.frames,
            "frames_tracked": len(self.online),
            "wall_s": self.wall_s,
            "fps": self.frames / self.wall_s,
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            "parameters": dict(parameters),
        }
        (out / REPORT).write_text(json.dumps(report, indent=2) + "\n")


def run_peer(peer: Peer, recording: Recording, frames: slice) -> PeerRun:
    """Feed the chosen frames of a recording to a peer as fast as it can take them."""
    started = time.perf_counter()
    stamps, online, count = [], [], 0
    for frame in recording.frames(frames.start or 0, frames.stop, frames.step or 1):
        pose = peer.process(frame)
        count += 1
        if pose is not None:
            stamps.append(frame.stamp_ns)
            online.append(orthonormalized(pose))
    refined = [orthonormalized(pose) for pose in peer.finish()]
    wall_s = time.perf_counter() - started
    stamps_ns = np.array(stamps, np.int64)
    return PeerRun(
        Trajectory(stamps_ns, np.array(online)),
        Trajectory(stamps_ns, np.array(refined)),
        count,
        wall_s,
    )
