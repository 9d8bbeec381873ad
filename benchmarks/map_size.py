"""Bytes and errors of maps of one space that is seen for longer and longer (paper, Table II).

    python benchmarks/map_size.py

A simulated `library` of 57 m³ is recorded once for 150 s: five rounds that differ a little. Its
first 30, 60, 90, 120 and 150 s are mapped by `meslam run`; the weights are then stored as fp32,
fp16 and int8, and the map's bytes are those of its whole folder. Open3D's TSDF volume, the mesh
of it and a cloud with a point in every cube of 1 cm are made of the same frames and the same
trusted pixels (of the cloud every second along rows and columns). They are given the true poses,
while ours finds its own: their errors have no trajectory in them. Their bytes are those of tightly
packed arrays, as they are and deflated; ours are compressed in the format already. The volume's
error is that of its mesh.

Errors are those of NICE-SLAM, over the true surface that was within 4 m of the camera
(`meslam_core.evaluation.reconstruction`); ours is meshed at 2 cm. Finished parts are kept in
benchmarks/.cache/map_size and not repeated, unless `--again` says so; the recording, 2.2 GB, is
made there if it is missing. Writes a table, JSON and a plot to docs/benchmarks/map_size.*.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from classic_maps import Content, PointCloud, TsdfVolume, mesh_content
from machine import machine
from map_size_figures import MAX_DEPTH_M, Row, write_results
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from scipy.spatial import cKDTree
from simulated import program, simulated

from meslam_core.config import MeslamConfig
from meslam_core.evaluation.reconstruction import (
    COMPLETION_DISTANCE_M,
    distances,
    observed_surface,
    surface_error,
)
from meslam_core.evaluation.trajectory_error import absolute_error
from meslam_core.map.mesh import extract_mesh
from meslam_core.map.mesh_file import to_open3d
from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.recordings.registry import open_recording
from meslam_core.results import MAP, REPORT, TRAJECTORY
from meslam_core.simulation.writer import surface_path
from meslam_core.tracking.pixels import trusted_pixels
from meslam_core.trajectory import Trajectory, read_tum

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "docs" / "benchmarks"
CACHE = HERE / ".cache" / "map_size"
LIBRARIES = ("open3d-cpu", "torch", "numpy")
DURATIONS_S = (30.0, 60.0, 90.0, 120.0, 150.0)
QUICK_S = (4.0, 8.0)
FPS = 15
METHODS = ("ours", "classics")
PRECISIONS = ("fp32", "fp16", "int8")
MESH_M = 0.02
VOXELS_M = (0.01, 0.02)
TRUNCATION_M = 0.08
CLOUD_M = 0.01
CLOUD_PIXEL_STEP = 2
# Measurements farther outside of the true surface than this are no part of a cloud.
CLOUD_MARGIN_M = 1.0
CLOUD_SAMPLES = 100_000


@dataclass(frozen=True)
class Space:
    """The recording and what is known of it.

    Attributes:
        recording: file.
        truth: T_truth_camera of every frame.
        surface: the exact surface in the truth's frame [m].
    """

    recording: Path
    truth: Trajectory
    surface: o3d.geometry.TriangleMesh

    @classmethod
    def read(cls, recording: Path) -> Space:
        surface = o3d.io.read_triangle_mesh(str(surface_path(recording)))
        return cls(recording, read_tum(recording.with_suffix(".truth.txt")), surface)

    def until(self, frames: int) -> Trajectory:
        """The true poses of the first frames."""
        return self.truth.subset(np.arange(min(frames, len(self.truth))))

    def observed(self, frames: int) -> NDArray[np.float32]:
        """Points (N, 3) of the surface that the first frames show [m]."""
        source = open_recording(self.recording)
        camera = source.camera
        source.close()
        return observed_surface(self.surface, camera, self.until(frames), farthest_m=MAX_DEPTH_M)


def folder_of(space: Space, seconds: float) -> Path:
    return CACHE / space.recording.stem / f"{seconds:g}s"


def our_rows(space: Space, seconds: float, settings: Sequence[str]) -> list[Row]:
    """Map the first seconds, store the map in every precision, and measure each."""
    frames, out = round(seconds * FPS), folder_of(space, seconds) / "meslam"
    if not (out / REPORT).exists():
        shutil.rmtree(out, ignore_errors=True)
        out.parent.mkdir(parents=True, exist_ok=True)
        changes = [word for each in ("map.codec=fp32", *settings) for word in ("--set", each)]
        truth = ["--truth", str(space.recording.with_suffix(".truth.txt"))]
        chosen = ["--frames", f"0:{frames}", "--out", str(out)]
        command = [program(), "run", str(space.recording), *chosen, *truth, *changes]
        subprocess.run(command, check=True)
    report = json.loads((out / REPORT).read_text())
    aligned = absolute_error(read_tum(out / TRAJECTORY), space.truth)
    observed = space.observed(frames)
    loaded = MapStore(out / MAP).load()
    rows = []
    for precision in PRECISIONS:
        store = MapStore(out / f"{precision}.meslam")
        store.save(loaded.regions, loaded.grid, loaded.map_id, precision, loaded.nodes)
        mesh = to_open3d(extract_mesh(NeuralMap.load(store.path), MESH_M))
        moved = aligned.mounting.T_truth_map
        error = surface_error(mesh, space.surface, observed, T_truth_map=moved)
        rows.append(
            Row(
                method=f"ours, {precision}",
                seconds=seconds,
                bytes=store.map_bytes,
                packed_bytes=store.map_bytes,
                error=error.to_dict(),
                ate_m=aligned.rmse_m,
                regions=int(report["regions"]),
            )
        )
    return rows


def classic_rows(space: Space, durations_s: Sequence[float]) -> Iterator[list[Row]]:
    """Maps from true poses, grown frame by frame and measured when a duration is over."""
    sensor = MeslamConfig().sensor
    volumes = {
        voxel_m: TsdfVolume(voxel_m, TRUNCATION_M, sensor.max_depth_m) for voxel_m in VOXELS_M
    }
    corners = np.asarray(space.surface.vertices)
    margin = np.array([[-CLOUD_MARGIN_M], [CLOUD_MARGIN_M]])
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)]) + margin
    cloud = PointCloud(bounds, CLOUD_M, CLOUD_PIXEL_STEP)
    source = open_recording(space.recording)
    frames, done = source.frames(), 0
    try:
        with Progress() as bar:
            task = bar.add_task("fusing", total=round(durations_s[-1] * FPS))
            for seconds in durations_s:
                for frame in islice(frames, round(seconds * FPS) - done):
                    trusted = trusted_pixels(frame.depth_m, sensor)
                    depth_m = np.where(trusted, frame.depth_m, np.float32(0.0))
                    at = int(np.abs(space.truth.stamps_ns - frame.stamp_ns).argmin())
                    view = depth_m, frame.color, frame.camera, space.truth.poses[at]
                    for each in (*volumes.values(), cloud):
                        each.add(*view)
                    done += 1
                    bar.advance(task)
                yield measured(space, seconds, volumes, cloud)
    finally:
        source.close()


def measured(
    space: Space, seconds: float, volumes: dict[float, TsdfVolume], cloud: PointCloud
) -> list[Row]:
    """Rows of the maps as they are now."""
    observed = space.observed(round(seconds * FPS))
    rows = []
    for voxel_m, volume in volumes.items():
        mesh = volume.mesh()
        error = surface_error(mesh, space.surface, observed).to_dict()
        name = f"{100 * voxel_m:g} cm"
        rows.append(row(f"TSDF mesh, {name}", seconds, mesh_content(mesh), error))
        rows.append(row(f"TSDF volume, {name}", seconds, volume.content(), error))
    error = cloud_error(cloud.points, space.surface, observed)
    rows.append(row(f"point cloud, {100 * CLOUD_M:g} cm", seconds, cloud.content(), error))
    return rows


def row(method: str, seconds: float, content: Content, error: dict[str, float]) -> Row:
    return Row(method, seconds, content.bytes, content.deflated_bytes, error)


def cloud_error(
    points: NDArray[np.float32],
    surface: o3d.geometry.TriangleMesh,
    observed: NDArray[np.floating],
) -> dict[str, float]:
    """The fields of `SurfaceError` for a map of points (N, 3) [m]."""
    chosen = np.random.default_rng(0).permutation(len(points))[:CLOUD_SAMPLES]
    accuracy = distances(points[chosen], surface)
    completion = cKDTree(points).query(observed)[0]
    return {
        "accuracy_median_m": float(np.median(accuracy)),
        "accuracy_mean_m": float(accuracy.mean()),
        "completion_median_m": float(np.median(completion)),
        "completion_mean_m": float(completion.mean()),
        "completion_ratio": float((completion < COMPLETION_DISTANCE_M).mean()),
    }


def kept(path: Path) -> list[Row] | None:
    """Rows of a finished part."""
    if not path.exists():
        return None
    return [Row(**values) for values in json.loads(path.read_text())]


def keep(path: Path, rows: Sequence[Row]) -> list[Row]:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(each) for each in rows]) + "\n")
    return list(rows)


def collect(space: Space, options: argparse.Namespace) -> list[Row]:
    """All rows, those of finished parts from the cache."""
    rows: list[Row] = []
    for seconds in options.durations if "ours" in options.methods else ():
        path = folder_of(space, seconds) / "ours.json"
        if "ours" in options.again:
            shutil.rmtree(path.parent / "meslam", ignore_errors=True)
            path.unlink(missing_ok=True)
        rows += kept(path) or keep(path, our_rows(space, seconds, options.set))
    if "classics" not in options.methods:
        return rows
    paths = [folder_of(space, seconds) / "classics.json" for seconds in options.durations]
    if "classics" in options.again or not all(path.exists() for path in paths):
        for path, found in zip(paths, classic_rows(space, options.durations), strict=True):
            keep(path, found)
    return rows + [each for path in paths for each in kept(path) or []]


def parsed_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--recording", type=Path, help="of the library; made if missing")
    parser.add_argument("--durations", type=float, nargs="+", default=list(DURATIONS_S))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--again", nargs="+", choices=METHODS, default=[], help="make these anew")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    seconds = " and ".join(f"{each:g}" for each in QUICK_S)
    parser.add_argument("--quick", action="store_true", help=f"{seconds} s of a short recording")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--note", default="", help="remark for the results")
    options = parser.parse_args()
    if options.quick:
        options.durations = list(QUICK_S)
    options.durations = sorted(options.durations)
    if options.recording is None:
        options.recording = CACHE / f"library_{options.durations[-1]:g}s.mcap"
    return options


def main() -> None:
    options = parsed_options()
    seconds = f"{options.durations[-1]:g}"
    space = Space.read(
        simulated("library", options.recording, "--duration", seconds, "--fps", str(FPS))
    )
    rows = collect(space, options)
    options.out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {
        "command": " ".join(["python", "benchmarks/map_size.py", *sys.argv[1:]]),
        "machine": machine(LIBRARIES),
        "settings": options.set,
        "note": options.note,
    }
    stem = options.out / ("map_size_quick" if options.quick else "map_size")
    write_results(rows, result, stem, Console(width=160, markup=False))


if __name__ == "__main__":
    main()
