"""One measured run through a large scene, in a process of its own.

    python benchmarks/large_scene_run.py RECORDING.mcap --out FOLDER [--preset NAME] [--set ...]

What `meslam run` does, frame by frame, with what a large scene is about noted at every frame:
memory, time, and how many regions there are and rest. Besides the trajectories, the map and the
report it writes FRAMES, a table of that. The error of a region's map is measured whenever another
one takes over; the clock stands still meanwhile.
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from machine import memory_mb
from numpy.typing import NDArray

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.reconstruction import sample
from meslam_core.evaluation.region_error import (
    RegionError,
    RegionVisits,
    error_at,
    fitted,
    in_box,
)
from meslam_core.loop.pose_graph import rigid_motion
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.stored_region import snapshot
from meslam_core.odometry import make_odometry
from meslam_core.odometry_worker import OdometryWorker
from meslam_core.recordings.registry import open_recording
from meslam_core.regions.grid import RegionIndex
from meslam_core.results import MAP, ONLINE_TRAJECTORY, TRAJECTORY, ResultFolder
from meslam_core.run_report import Tally, map_entries, run_environment
from meslam_core.session_map import write_map
from meslam_core.slam import FrameResult, Slam
from meslam_core.threads import limit_threads
from meslam_core.trajectory import Trajectory, read_tum, write_tum

FRAMES = "frames.npz"
SURFACE_POINTS = 300_000
TOLD_EVERY = 100


@dataclass(frozen=True)
class FrameNote:
    """What is noted of a frame.

    Attributes:
        stamp_ns: of its image [ns].
        wall_s: since the first frame was asked for, without the measurements [s].
        rss_mb, peak_mb: memory, and the most so far [MB].
        regions, resting: how many there are, and how many of them rest on disk.
        keyframes: so far.
        tracking_ms, mapping_ms: times of the stages [ms].
        state: of tracking.
    """

    stamp_ns: int
    wall_s: float
    rss_mb: float
    peak_mb: float
    regions: int
    resting: int
    keyframes: int
    tracking_ms: float
    mapping_ms: float
    state: int


class RegionSurface:
    """The error of a region's map, wherever the region lies.

    Always the same points of the true surface count: those that the region had observed when it
    was first asked for. They are placed by the true poses of the keyframes that it had then, and
    moved rigidly onto its map from there: a correction of the path moves a region and its
    keyframes by millimetres in relation to each other, which would count although its map has not
    changed. Where regions lie is what the trajectory's error and that of the whole map tell.

    Args:
        slam: whose regions are measured.
        surface: (N, 3) points in the truth's frame [m].
        truth: T_truth_camera of the recording.
    """

    def __init__(self, slam: Slam, surface: NDArray[np.floating], truth: Trajectory) -> None:
        self._slam = slam
        self._surface = surface
        self._truth = truth
        self._known: dict[RegionIndex, tuple[list[int], NDArray[np.floating]]] = {}

    def error(self, index: RegionIndex) -> RegionError:
        """Of a region's map as it is now; nothing may train."""
        assert self._slam.atlas is not None
        region = self._slam.atlas.regions[index]
        placed = PlacedRegion(snapshot(region, 0), "auto")
        if index not in self._known:
            # What came later may have been registered differently.
            keyframes = list(region.keyframes)
            seen = in_box(placed, self._in_map(keyframes, self._surface))
            self._known[index] = keyframes, self._surface[seen]
        keyframes, points = self._known[index]
        return error_at(placed, fitted(placed, self._in_map(keyframes, points)))

    def _in_map(self, keyframes: list[int], points: NDArray[np.floating]) -> NDArray[np.float64]:
        store = self._slam.keyframes
        stamps_ns = np.array([store.stamps_ns[k] for k in keyframes])
        rows = np.searchsorted(self._truth.stamps_ns, stamps_ns)
        T = rigid_motion(self._truth.poses[rows], store.poses()[keyframes])
        return np.asarray(points @ T[:3, :3].T + T[:3, 3], np.float64)


class Measured:
    """A run and what is noted of it.

    Attributes:
        notes: of the frames so far.
        visits: of the regions; empty for one network.
        online_s: until the last frame was mapped, without the measurements [s].
        refined_s: the same until the map was refined [s].
        refined_mb, peak_mb: memory after that, and the most so far [MB].
    """

    def __init__(self, path: Path, config: MeslamConfig, seed: int) -> None:
        self.notes: list[FrameNote] = []
        self.online_s = self.refined_s = self.refined_mb = self.peak_mb = 0.0
        self.tally = Tally()
        self.slam = Slam(config, seed)
        self._path = path
        self._config = config
        truth = read_tum(path.with_suffix(".truth.txt"))
        mesh = o3d.io.read_triangle_mesh(str(path.with_suffix(".surface.ply")))
        surface = RegionSurface(self.slam, sample(mesh, SURFACE_POINTS), truth)
        self.visits = RegionVisits(surface.error)

    def run(self, frames: slice) -> None:
        """Process the frames and refine the map."""
        started = time.perf_counter()
        config = self._config
        with closing(open_recording(self._path)) as recording:
            odometry = make_odometry(config.odometry, config.sensor)
            read = recording.frames(frames.start or 0, frames.stop, frames.step or 1)
            with closing(iter(OdometryWorker(read, odometry, config.runtime.queue))) as ready:
                for timed in ready:
                    result = self.slam.process(timed.frame, timed.odometry)
                    self.tally.add(result, timed.reading_ms, timed.odometry_ms)
                    self._note(result, time.perf_counter() - started)
                    started += self._measure()
        self.slam.wait()
        self.online_s = time.perf_counter() - started
        self.slam.finish()
        self.refined_s = time.perf_counter() - started
        self.refined_mb, self.peak_mb = memory_mb(os.getpid())

    def _note(self, result: FrameResult, wall_s: float) -> None:
        regions = self.slam.atlas.regions.values() if self.slam.atlas else ()
        rss_mb, peak_mb = memory_mb(os.getpid())
        self.notes.append(
            FrameNote(
                result.stamp_ns,
                wall_s,
                rss_mb,
                peak_mb,
                len(regions),
                sum(region.at_rest for region in regions),
                len(self.slam.keyframes),
                result.tracking_ms,
                result.mapping_ms,
                int(result.state),
            )
        )
        if len(self.notes) % TOLD_EVERY == 0:
            print(
                f"{len(self.notes)} frames, {len(self.notes) / wall_s:.1f}/s, "
                f"{len(regions)} regions, {rss_mb:.0f} MB, {result.state.name}",
                flush=True,
            )

    def _measure(self) -> float:
        """Errors of the regions where another one takes over; the time that took [s]."""
        started = time.perf_counter()
        atlas = self.slam.atlas
        if atlas is None or self._config.regions.single:
            return 0.0
        working = atlas.working.index
        if not self.visits.visits or self.visits.visits[-1].region != working:
            self.slam.wait()
            self.visits.follow(working)
        return time.perf_counter() - started

    def report(self) -> dict[str, Any]:
        """The content of the report."""
        recogniser = self.slam.recogniser
        return {
            **self.tally.entries(),
            **map_entries(self.slam),
            "online_s": self.online_s,
            "wall_s": self.refined_s,
            "fps": self.tally.frames / self.online_s,
            "corrections": recogniser.corrections if recogniser else 0,
            "refined_mb": self.refined_mb,
            "peak_mb": self.peak_mb,
            "config": self._config.to_mapping(),
            "visits": [_without_nan(asdict(visit)) for visit in self.visits.visits],
            **run_environment(),
        }


def _without_nan(entries: dict[str, Any]) -> dict[str, Any]:
    """A region that was left before it saw anything of its box has no error: None."""
    return {
        name: _without_nan(value)
        if isinstance(value, dict)
        else None
        if isinstance(value, float) and np.isnan(value)
        else value
        for name, value in entries.items()
    }


def columns(notes: list[FrameNote]) -> dict[str, NDArray[Any]]:
    """The notes as one array a column."""
    return {
        field.name: np.array([getattr(note, field.name) for note in notes])
        for field in fields(FrameNote)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--frames", default=":", metavar="A:B[:STEP]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    config = MeslamConfig.from_overrides(options.set, options.preset)
    limit_threads(config.runtime.threads)
    frames = slice(*(int(part) if part else None for part in options.frames.split(":")))
    measured = Measured(options.recording, config, options.seed)
    with ResultFolder(options.out) as results:
        measured.run(frames)
        slam = measured.slam
        write_tum(results.incomplete(TRAJECTORY), slam.trajectory())
        write_tum(results.incomplete(ONLINE_TRAJECTORY), slam.online_trajectory())
        last_ns = measured.tally.last_stamp_ns
        report = measured.report()
        report["map_bytes"] = write_map(slam, last_ns, results.incomplete(MAP))
        results.write_report(report)
        results.publish()
    with (options.out / FRAMES).open("wb") as file:
        np.savez(file, allow_pickle=False, **columns(measured.notes))


if __name__ == "__main__":
    main()
