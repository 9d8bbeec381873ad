"""Map quality against CPU seconds with given poses, ours and Open3D's TSDF on the same keyframes.

    MESLAM_DATA=folder python benchmarks/map_quality.py

Keyframes are chosen by their motion alone, with the poses of the truth; every tenth frame is kept
out and never becomes one. Ours is trained by the classes that the pipeline uses, on one thread and
with the poses held fixed, for so many CPU seconds (setting up the keyframes counts, decoding images
does not); the learning rate falls over each budget as it does in the pipeline's last refinement.
The TSDF integrates the keyframes' whole images with several truncations, with and without the
depth edges, and with surfaces seen once or twice as its answer; the best of them is reported for
each voxel size. Rays are cast at its mesh: Open3D's own ray-caster looks voxels up without
interpolation and is off by half a voxel. All are asked for the same pixels of the frames kept out,
those whose measured depth is in the sensor's range. Writes a table, JSON and a plot to
docs/benchmarks/map_quality.*.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from machine import machine, machine_line
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from meslam_core.camera import PinholeCamera
from meslam_core.config import KeyframesConfig, MeslamConfig, SensorConfig
from meslam_core.frame import RgbdFrame
from meslam_core.se3 import Pose, interpolate, inverse, rotation_angle
from meslam_core.slam import T_BODY_OPTICAL
from meslam_core.threads import limit_threads
from meslam_core.trajectory import Trajectory, read_tum

limit_threads(1)

import open3d as o3d  # noqa: E402

from meslam_core.evaluation.views import MeshRenderer  # noqa: E402
from meslam_core.field import field_device  # noqa: E402
from meslam_core.map.neural_map import NeuralMap  # noqa: E402
from meslam_core.map.stored_region import snapshot  # noqa: E402
from meslam_core.mapping.joint_optimizer import JointOptimizer  # noqa: E402
from meslam_core.mapping.keyframes import KeyframeStore, rays_at  # noqa: E402
from meslam_core.mapping.refinement import LAST_RATE_FACTOR  # noqa: E402
from meslam_core.recordings.registry import open_recording  # noqa: E402
from meslam_core.regions.atlas import RegionAtlas  # noqa: E402
from meslam_core.tracking.pixels import choose_pixels, trusted_pixels  # noqa: E402

mpl.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

LIBRARIES = ("open3d-cpu", "torch", "numpy")
ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "benchmarks"
BUDGETS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
DECIDING_S = 10.0
KEPT_OUT_EVERY = 10
PIXEL_STRIDE = 8
MAX_TRUTH_GAP_NS = 50_000_000
CLIP_M = 0.10
PORTION_STEPS = 20
# Rays are followed in steps that cannot jump over the truncated band behind a surface.
MARCH_STEP_M = 0.05
BISECTIONS = 6
VOXELS_M = (0.01, 0.02)
TRUNCATION_VOXELS = (4.0, 8.0)
MIN_OBSERVATIONS = (1, 2)
TSDF_BLOCK_VOXELS = 8
TSDF_BLOCKS = 10_000


@dataclass(frozen=True)
class Source:
    """A recording and its true poses."""

    name: str
    recording: Path
    truth: Path


@dataclass(frozen=True)
class View:
    """A frame and its true pose T_map_camera (4, 4)."""

    frame: RgbdFrame
    T_map_camera: Pose


@dataclass(frozen=True)
class Scene:
    """What the methods map, and the frames they are judged by."""

    name: str
    keyframes: list[View]
    kept_out: list[View]


@dataclass(frozen=True)
class Answers:
    """What a map shows at the pixels asked for.

    Attributes:
        depth_m: (N,) along the optical axis, NaN where the map has no answer [m].
        color: (N, 3) in [0, 1].
    """

    depth_m: NDArray[np.float32]
    color: NDArray[np.float32]


@dataclass(frozen=True)
class Attempt:
    """The answers of one method, and what they cost."""

    method: str
    settings: str
    cpu_s: float
    steps: int
    answers: Answers


@dataclass(frozen=True)
class Score:
    """One row of the result.

    Attributes:
        scene, method, settings, cpu_s, steps: what was measured.
        answered: share of the pixels asked for that have an answer.
        median_cm, clipped_cm: median absolute depth error, and mean of the error clipped at
            10 cm, at the pixels that every method of the scene answers [cm].
        all_median_cm, all_clipped_cm: the same at all pixels, an unanswered one counts as 10 cm.
        bias_cm: median of rendered minus measured depth at the pixels that all answer [cm].
        psnr_db: of the colour there.
    """

    scene: str
    method: str
    settings: str
    cpu_s: float
    steps: int
    answered: float
    median_cm: float
    clipped_cm: float
    all_median_cm: float
    all_clipped_cm: float
    bias_cm: float
    psnr_db: float


def sources() -> list[Source]:
    """The recordings at hand: those below MESLAM_DATA, and the demo's simulated room."""
    room = ROOT / "bags" / "room_20s_seed1.mcap"
    found = [Source("simulated room", room, room.with_suffix(".truth.txt"))]
    if "MESLAM_DATA" in os.environ:
        data = Path(os.environ["MESLAM_DATA"])
        for name, truth in (
            ("tum_fr1_xyz", "groundtruth.txt"),
            ("livingroom", "reference_poses.txt"),
        ):
            found.append(Source(name, data / name, data / name / truth))
    return [source for source in found if source.recording.exists() and source.truth.exists()]


def pose_at(truth: Trajectory, stamp_ns: int) -> Pose | None:
    """The true pose (4, 4) at a time, between its neighbours; None where they are far."""
    after = int(np.searchsorted(truth.stamps_ns, stamp_ns))
    before = after - 1
    if after < len(truth) and truth.stamps_ns[after] == stamp_ns:
        return truth.poses[after]
    if before < 0 or after == len(truth):
        return None
    start, end = int(truth.stamps_ns[before]), int(truth.stamps_ns[after])
    if end - start > MAX_TRUTH_GAP_NS:
        nearest = before if stamp_ns - start < end - stamp_ns else after
        close = abs(int(truth.stamps_ns[nearest]) - stamp_ns) < MAX_TRUTH_GAP_NS // 50
        return truth.poses[nearest] if close else None
    return interpolate(truth.poses[before], truth.poses[after], (stamp_ns - start) / (end - start))


def load_scene(source: Source, config: MeslamConfig) -> Scene:
    """Keyframes and frames kept out; the map frame is the pipeline's, from the first camera."""
    truth = read_tum(source.truth)
    recording = open_recording(source.recording)
    keyframes: list[View] = []
    kept_out: list[View] = []
    T_map_world: Pose | None = None
    try:
        for number, frame in enumerate(recording.frames()):
            T_world_camera = pose_at(truth, frame.stamp_ns)
            if T_world_camera is None:
                continue
            if T_map_world is None:
                T_map_world = T_BODY_OPTICAL @ inverse(T_world_camera)
            view = View(frame, T_map_world @ T_world_camera)
            if number % KEPT_OUT_EVERY == KEPT_OUT_EVERY // 2:
                kept_out.append(view)
            elif not keyframes or shows_more(keyframes[-1], view, config.keyframes, config.sensor):
                keyframes.append(view)
    finally:
        recording.close()
    return Scene(source.name, keyframes, kept_out)


def shows_more(last: View, view: View, keyframes: KeyframesConfig, sensor: SensorConfig) -> bool:
    """The pipeline's rule for a keyframe without the part that asks the map."""
    offset = inverse(last.T_map_camera) @ view.T_map_camera
    if np.linalg.norm(offset[:3, 3]) > keyframes.translation_m:
        return True
    if np.rad2deg(rotation_angle(offset)) > keyframes.rotation_deg:
        return True
    rows, columns, depth_m = asked_pixels(view.frame, sensor)
    camera = view.frame.camera
    points = camera.ray_directions(columns, rows) * depth_m[:, None]
    u, v, z = camera.project(points @ offset[:3, :3].T + offset[:3, 3])
    inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return bool(len(inside)) and float(np.mean(inside)) < keyframes.overlap


def asked_pixels(
    frame: RgbdFrame, sensor: SensorConfig
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Rows, columns and measured depths of every so many pixels whose depth is in range."""
    grid = np.zeros(frame.depth_m.shape, bool)
    grid[PIXEL_STRIDE // 2 :: PIXEL_STRIDE, PIXEL_STRIDE // 2 :: PIXEL_STRIDE] = True
    grid &= (frame.depth_m >= sensor.min_depth_m) & (frame.depth_m <= sensor.max_depth_m)
    rows, columns = np.nonzero(grid)
    return rows, columns, frame.depth_m[rows, columns]


def measured(scene: Scene, sensor: SensorConfig) -> Answers:
    """Depth and colour of all pixels asked for, as the camera measured them."""
    depths, colors = [], []
    for view in scene.kept_out:
        rows, columns, depth_m = asked_pixels(view.frame, sensor)
        depths.append(depth_m)
        colors.append(view.frame.color[rows, columns].astype(np.float32) / 255.0)
    return Answers(np.concatenate(depths), np.concatenate(colors))


class NeuralMapper:
    """The pipeline's mapping with given poses.

    Attributes:
        cpu_s: time spent so far [s].
        steps: of training so far.
    """

    def __init__(self, scene: Scene, config: MeslamConfig, seed: int) -> None:
        self.config = config
        started = time.process_time()
        generator = np.random.default_rng(seed)
        kept = config.keyframes
        store = KeyframeStore(kept.rays, field_device(config.field), kept.ray_budget, seed)
        position = scene.keyframes[0].T_map_camera[:3, 3]
        self.atlas = RegionAtlas(config, position, store, seed)
        for view in scene.keyframes:
            pixels = trusted_pixels(view.frame.depth_m, config.sensor)
            chosen = choose_pixels(pixels, config.keyframes.rays, generator)
            if not len(chosen[0]):
                continue
            self.atlas.update(view.T_map_camera[:3, 3])
            rays = rays_at(view.frame, *chosen)
            self.atlas.add_keyframe(store.add(view.frame.stamp_ns, view.T_map_camera, rays))
        self.optimizer = JointOptimizer(store, config.mapping, seed)
        self.cpu_s = time.process_time() - started
        self.steps = 0

    def train_until(self, budget_s: float) -> None:
        """Train all regions, in turn and in proportion to their keyframes, until so many seconds.

        The learning rate falls from its full value to the pipeline's last over the budget.
        """
        regions = list(self.atlas.regions.values())
        total = sum(len(region.keyframes) for region in regions)
        while self.cpu_s < budget_s:
            started = time.process_time()
            rate = 1.0 + self.cpu_s / budget_s * (LAST_RATE_FACTOR - 1.0)
            for region in regions:
                steps = max(1, round(PORTION_STEPS * len(region.keyframes) / total))
                self.optimizer.train(region, steps, refine_poses=False, rate_factor=rate)
                self.steps += steps
            self.cpu_s += time.process_time() - started

    def neural_map(self) -> NeuralMap:
        """The map as the pipeline would store it, before compression."""
        return NeuralMap(
            [snapshot(region, 0) for region in self.atlas.regions.values()], self.config.map
        )


def ask_neural_map(neural_map: NeuralMap, scene: Scene, config: MeslamConfig) -> Answers:
    """Depth and colour of the first surface along each pixel's ray."""
    depths, colors = [], []
    for view in scene.kept_out:
        rows, columns, _ = asked_pixels(view.frame, config.sensor)
        directions = view.frame.camera.ray_directions(columns, rows)
        directions = directions @ view.T_map_camera[:3, :3].T.astype(np.float32)
        depth_m, color = first_surface(
            neural_map, view.T_map_camera[:3, 3], directions, config.sensor.max_depth_m
        )
        depths.append(depth_m)
        colors.append(color)
    return Answers(np.concatenate(depths), np.concatenate(colors))


def first_surface(
    neural_map: NeuralMap,
    origin: NDArray[np.floating],
    directions: NDArray[np.float32],
    max_depth_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where rays first pass from free space through a surface.

    Args:
        neural_map: to ask.
        origin: (3,) camera centre, map frame [m].
        directions: (R, 3) map axes, of length 1 along the optical axis.
        max_depth_m: where the search ends.

    Returns:
        (R,) depth along the optical axis [m], NaN without a surface, and (R, 3) colour there.
    """

    def inside(rays: NDArray[np.intp], depth: NDArray[np.floating]) -> NDArray[np.bool_]:
        points = origin + depth[:, None] * directions[rays]
        # Unknown space (NaN) stops no ray.
        return neural_map.values(points).distance > neural_map.surface_level

    depth_m = np.full(len(directions), np.nan, np.float32)
    going = np.arange(len(directions))
    for depth in np.arange(MARCH_STEP_M, max_depth_m + 2 * CLIP_M, MARCH_STEP_M):
        if not len(going):
            break
        hit = inside(going, np.full(len(going), depth))
        depth_m[going[hit]] = depth
        going = going[~hit]
    found = np.flatnonzero(np.isfinite(depth_m))
    behind = depth_m[found].astype(np.float64)
    before = behind - MARCH_STEP_M
    for _ in range(BISECTIONS):
        middle = 0.5 * (before + behind)
        hit = inside(found, middle)
        behind, before = np.where(hit, middle, behind), np.where(hit, before, middle)
    depth_m[found] = 0.5 * (before + behind)
    color = np.zeros((len(directions), 3), np.float32)
    points = origin + behind[:, None] * directions[found]
    color[found] = np.nan_to_num(neural_map.color(points)) if len(found) else 0.0
    return depth_m, color


def neural_attempts(
    scene: Scene, config: MeslamConfig, budgets_s: Sequence[float], seed: int
) -> Iterator[Attempt]:
    """A training run of its own for every budget."""
    for budget_s in budgets_s:
        mapper = NeuralMapper(scene, config, seed)
        mapper.train_until(budget_s)
        answers = ask_neural_map(mapper.neural_map(), scene, config)
        yield Attempt(ours(budget_s), f"seed {seed}", mapper.cpu_s, mapper.steps, answers)


def ours(budget_s: float) -> str:
    return f"ours, {budget_s:g} s"


def tsdf_attempts(scene: Scene, voxel_m: float, sensor: SensorConfig) -> Iterator[Attempt]:
    """Open3D's TSDF with every combination of the settings that matter."""
    for truncation in TRUNCATION_VOXELS:
        for without_edges in (False, True):
            started = time.process_time()
            grid = integrate_tsdf(scene, voxel_m, truncation, without_edges, sensor)
            cpu_s = time.process_time() - started
            for observations in MIN_OBSERVATIONS:
                settings = f"truncation {truncation:g} voxels, seen {observations} times"
                settings += ", no depth edges" if without_edges else ""
                mesh = grid.extract_triangle_mesh(weight_threshold=observations - 0.5)
                answers = ask_mesh(mesh.to_legacy(), scene, sensor)
                yield Attempt(tsdf(voxel_m), settings, cpu_s, 0, answers)


def tsdf(voxel_m: float) -> str:
    return f"TSDF {100 * voxel_m:g} cm"


def integrate_tsdf(
    scene: Scene, voxel_m: float, truncation: float, without_edges: bool, sensor: SensorConfig
) -> Any:
    """A voxel block grid of the keyframes' whole images."""
    single = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (single, single, single),
        ((1,), (1,), (3,)),
        voxel_m,
        TSDF_BLOCK_VOXELS,
        TSDF_BLOCKS,
    )
    for view in scene.keyframes:
        depth_m = view.frame.depth_m
        if without_edges:
            depth_m = np.where(trusted_pixels(depth_m, sensor), depth_m, np.float32(0.0))
        depth = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth_m)))
        color = o3d.t.geometry.Image(o3d.core.Tensor(view.frame.color.astype(np.float32) / 255.0))
        # Open3D cuts projected coordinates off where the nearest pixel is meant.
        intrinsics = view.frame.camera.matrix
        intrinsics[:2, 2] += 0.5
        matrix = o3d.core.Tensor(intrinsics)
        extrinsic = o3d.core.Tensor(inverse(view.T_map_camera))
        limits = (1.0, sensor.max_depth_m, truncation)
        blocks = grid.compute_unique_block_coordinates(depth, matrix, extrinsic, *limits)
        grid.integrate(blocks, depth, color, matrix, extrinsic, *limits)
    return grid


def ask_mesh(mesh: o3d.geometry.TriangleMesh, scene: Scene, sensor: SensorConfig) -> Answers:
    """Depth and colour of the mesh's first surface along each pixel's ray."""
    renderer = MeshRenderer(mesh)
    depths, colors = [], []
    for view in scene.kept_out:
        color, depth_m = renderer.render(asked_camera(view.frame.camera), view.T_map_camera)
        rows, columns, _ = asked_pixels(view.frame, sensor)
        place = rows // PIXEL_STRIDE, columns // PIXEL_STRIDE
        depths.append(np.where(depth_m[place] > 0, depth_m[place], np.float32(np.nan)))
        colors.append(color[place].astype(np.float32) / 255.0)
    return Answers(np.concatenate(depths), np.concatenate(colors))


def asked_camera(camera: PinholeCamera) -> PinholeCamera:
    """A camera with no other pixels than those that are asked for."""
    return PinholeCamera(
        width=len(range(PIXEL_STRIDE // 2, camera.width, PIXEL_STRIDE)),
        height=len(range(PIXEL_STRIDE // 2, camera.height, PIXEL_STRIDE)),
        fx=camera.fx / PIXEL_STRIDE,
        fy=camera.fy / PIXEL_STRIDE,
        cx=(camera.cx - PIXEL_STRIDE // 2) / PIXEL_STRIDE,
        cy=(camera.cy - PIXEL_STRIDE // 2) / PIXEL_STRIDE,
    )


def score(scene: str, attempt: Attempt, truth: Answers, common: NDArray[np.bool_]) -> Score:
    """Errors of an attempt; `common` (N,) are the pixels that every method answers."""
    answers = attempt.answers
    answered = np.isfinite(answers.depth_m)
    difference = answers.depth_m - truth.depth_m
    error = np.where(answered, np.abs(difference), CLIP_M)
    squared = np.mean((np.clip(answers.color, 0.0, 1.0) - truth.color)[common] ** 2)
    return Score(
        scene=scene,
        method=attempt.method,
        settings=attempt.settings,
        cpu_s=attempt.cpu_s,
        steps=attempt.steps,
        answered=float(np.mean(answered)),
        median_cm=100 * float(np.median(error[common])),
        clipped_cm=100 * float(np.mean(error[common].clip(max=CLIP_M))),
        all_median_cm=100 * float(np.median(error)),
        all_clipped_cm=100 * float(np.mean(error.clip(max=CLIP_M))),
        bias_cm=100 * float(np.median(difference[common])),
        psnr_db=-10 * float(np.log10(max(squared, 1e-12))),
    )


def scores(scene: str, attempts: Sequence[Attempt], truth: Answers) -> list[Score]:
    """Scores of the attempts; of several with the same name the best counts.

    Best is the lowest mean clipped error over all pixels, where holes cost as much as errors.
    The pixels that all answer are found among the best.
    """

    def cost(attempt: Attempt) -> float:
        return score(scene, attempt, truth, np.ones(len(truth.depth_m), bool)).all_clipped_cm

    best: dict[str, Attempt] = {}
    for attempt in attempts:
        if attempt.method not in best or cost(attempt) < cost(best[attempt.method]):
            best[attempt.method] = attempt
    common = np.all([np.isfinite(a.answers.depth_m) for a in best.values()], axis=0)
    return [score(scene, attempt, truth, common) for attempt in best.values()]


def measure(
    source: Source, config: MeslamConfig, budgets_s: Sequence[float], seeds: Sequence[int]
) -> list[Score]:
    """All methods on one recording; of several seeds the one in the middle counts."""
    scene = load_scene(source, config)
    truth = measured(scene, config.sensor)
    attempts = [a for voxel_m in VOXELS_M for a in tsdf_attempts(scene, voxel_m, config.sensor)]
    runs = [list(neural_attempts(scene, config, budgets_s, seed)) for seed in seeds]
    for same_budget in zip(*runs, strict=True):
        attempts.append(middle(same_budget, truth))
    return scores(source.name, attempts, truth)


def middle(attempts: Sequence[Attempt], truth: Answers) -> Attempt:
    """The attempt with the median of the median errors, over all pixels."""
    everywhere = np.ones(len(truth.depth_m), bool)
    ordered = sorted(
        attempts, key=lambda attempt: score("", attempt, truth, everywhere).all_median_cm
    )
    return ordered[(len(ordered) - 1) // 2]


def verdicts(found: Sequence[Score]) -> list[str]:
    """For every scene, whether ours is no worse than the 1 cm TSDF when it should be."""
    lines = []
    for scene in dict.fromkeys(each.scene for each in found):
        by_method = {each.method: each for each in found if each.scene == scene}
        if ours(DECIDING_S) not in by_method:
            continue
        neural, peer = by_method[ours(DECIDING_S)], by_method[tsdf(VOXELS_M[0])]
        kept = neural.median_cm <= peer.median_cm
        lines.append(
            f"{scene}: median depth error after {DECIDING_S:g} CPU-seconds {neural.median_cm:.2f} "
            f"cm, {'no worse' if kept else 'WORSE'} than the 1 cm TSDF's {peer.median_cm:.2f} cm"
        )
    return lines


def table_of(found: Sequence[Score]) -> Table:
    table = Table(title="Frames kept out: errors of depth where all answer, and everywhere")
    table.add_column("scene")
    table.add_column("method")
    for name in ("CPU [s]", "steps", "answered", "median [cm]", "clipped [cm]"):
        table.add_column(name, justify="right")
    for name in ("all: median", "all: clipped", "bias [cm]", "PSNR [dB]"):
        table.add_column(name, justify="right")
    for each in found:
        table.add_row(
            each.scene,
            each.method,
            f"{each.cpu_s:.1f}",
            str(each.steps or ""),
            f"{each.answered:.1%}",
            f"{each.median_cm:.2f}",
            f"{each.clipped_cm:.2f}",
            f"{each.all_median_cm:.2f}",
            f"{each.all_clipped_cm:.2f}",
            f"{each.bias_cm:+.2f}",
            f"{each.psnr_db:.1f}",
        )
    return table


def plot(found: Sequence[Score], path: Path) -> None:
    """Median error and PSNR over CPU seconds, one column a scene."""
    scenes = list(dict.fromkeys(each.scene for each in found))
    figure, axes = plt.subplots(
        2, len(scenes), figsize=(4.5 * len(scenes), 7), layout="constrained", squeeze=False
    )
    for column, scene in enumerate(scenes):
        rows = [each for each in found if each.scene == scene]
        neural = [each for each in rows if each.method.startswith("ours")]
        peers = [each for each in rows if not each.method.startswith("ours")]
        for axis, name in zip(axes[:, column], ("median_cm", "psnr_db"), strict=True):
            cpu_s = [each.cpu_s for each in neural]
            axis.plot(cpu_s, [getattr(each, name) for each in neural], "o-", label="ours")
            for number, peer in enumerate(peers, start=1):
                value, color = getattr(peer, name), f"C{number}"
                axis.plot(peer.cpu_s, value, "s", color=color, label=peer.method)
                axis.axhline(value, color=color, lw=0.8, ls=":")
            axis.set(xscale="log", xlabel="CPU time [s]")
            axis.spines[["top", "right"]].set_visible(False)
        axes[0, column].set(title=scene, ylabel="median depth error [cm]", ylim=(0, None))
        axes[1, column].set(ylabel="PSNR of colour [dB]")
    axes[0, 0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--scene", action="append", help="only this one; may be repeated")
    parser.add_argument("--budgets", type=float, nargs="+", default=BUDGETS_S, help="[s]")
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1, 2))
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    options = parser.parse_args()
    chosen = [s for s in sources() if not options.scene or s.name in options.scene]
    if not chosen:
        parser.error("there is no such recording; set MESLAM_DATA, or make the demo's (make demo)")
    config = MeslamConfig.from_overrides(options.set)
    console = Console(markup=False)
    found: list[Score] = []
    for source in chosen:
        found += measure(source, config, options.budgets, options.seeds)
        console.print(table_of([each for each in found if each.scene == source.name]))
    for line in verdicts(found):
        console.print(line)
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "map_quality"
    described = machine(LIBRARIES)
    with stem.with_suffix(".txt").open("w") as file:
        command = " ".join(["python", "benchmarks/map_quality.py", *sys.argv[1:]])
        file.write(f"Made by `{command}`, on one thread\n\n")
        file.write(f"{machine_line(described)}\n\n")
        Console(file=file, width=150, markup=False).print(table_of(found))
        for each in found:
            if not each.steps:
                file.write(f"{each.scene}, {each.method}: {each.settings}\n")
        file.write("\n" + "\n".join(verdicts(found)) + "\n")
    plot(found, stem.with_suffix(".png"))
    result = {
        "machine": described,
        "budgets_s": list(options.budgets),
        "seeds": list(options.seeds),
        "settings": options.set,
        "scores": [asdict(each) for each in found],
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
