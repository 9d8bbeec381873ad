"""Throughput of the compiled field kernel for each width and instruction set, against torch.

    python benchmarks/kernel_throughput.py

Times inference and a training step of mapping: 880 rays of 10 samples, from values over rendering
and losses to the gradients of weights, embedding, phases and rays, and Adam. Every variant runs in
a process of its own, several rounds in turn; the shortest time counts, since other work on the
machine only ever adds. Writes a table, JSON and a plot to docs/benchmarks/kernel_throughput.*.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from meslam_core.config import FieldConfig, MappingConfig
from meslam_core.field.kernel import KernelField, available_isas
from meslam_core.field.model import ADAM_BETAS, ADAM_EPSILON
from meslam_core.field.network import FieldNetwork
from meslam_core.field.rendering import render
from meslam_core.field.sampling import sample_distances
from meslam_core.mapping.losses import ray_losses

mpl.use("Agg")
from matplotlib import pyplot as plt

WIDTHS = (64, 128, 256)
RAYS = 880
MAPPING = MappingConfig(free_samples=5, surface_samples=5)
STEP_POINTS = RAYS * (MAPPING.free_samples + MAPPING.surface_samples)
INFERENCE_POINTS = 100_000
RESULTS = Path(__file__).resolve().parent.parent / "docs" / "benchmarks"
# What keeps each of torch's libraries from using more than AVX2.
ONLY_AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "DNNL_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
}


@dataclass(frozen=True)
class Variant:
    """One way to compute the field.

    Attributes:
        name: of the row in the table.
        isa: instruction set of the kernel; empty for torch.
        threads: that it may use.
        bfloat16: torch's autocast to bfloat16.
        environment: variables set for its process.
    """

    name: str
    isa: str
    threads: int
    bfloat16: bool = False
    environment: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Timing:
    """Shortest times of one variant at one width."""

    variant: str
    width: int
    threads: int
    step_ms: float
    inference_points_per_s: float


def variants() -> list[Variant]:
    """Torch on two threads, then the kernel with every instruction set on one and two."""
    torch_variants = [
        Variant("torch fp32", "", 2),
        Variant("torch bf16 autocast", "", 2, bfloat16=True),
        Variant("torch fp32, AVX2 only", "", 2, environment=tuple(ONLY_AVX2.items())),
    ]
    return torch_variants + [
        Variant(f"kernel {isa}", isa, threads) for isa in available_isas() for threads in (1, 2)
    ]


def shortest(work: Callable[[], object], seconds: float) -> float:
    """Shortest time of a call [s]; repeats for about `seconds`, at least five times."""
    best = np.inf
    end = time.perf_counter() + seconds
    calls = 0
    while calls < 5 or time.perf_counter() < end:
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
        calls += 1
    return best


def random_points(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3)).astype(np.float32)


@dataclass(frozen=True)
class Rays:
    """Rays in region coordinates with their samples, as `KernelField.train_rays` takes them."""

    origins: torch.Tensor
    directions: torch.Tensor
    distances_m: torch.Tensor
    colors: torch.Tensor
    along_m: torch.Tensor


def random_rays() -> Rays:
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator)) / 1.5
    distances = torch.rand(RAYS, generator=generator) * 2 + 0.5
    return Rays(
        origins=torch.rand(RAYS, 3, generator=generator) * 0.2,
        directions=directions,
        distances_m=distances,
        colors=torch.rand(RAYS, 3, generator=generator),
        along_m=sample_distances(distances, MAPPING, generator),
    )


def time_kernel(variant: Variant, config: FieldConfig, seconds: float) -> tuple[float, float]:
    """Times of a step and of inference [s]."""
    field = KernelField(config, isa=variant.isa, threads=variant.threads)
    rays = random_rays()
    arrays = [
        tensor.numpy()
        for tensor in (rays.origins, rays.directions, rays.distances_m, rays.colors, rays.along_m)
    ]

    def step() -> None:
        field.train_rays(*arrays, MAPPING)
        field.step(1e-6)

    many = random_points(INFERENCE_POINTS)
    return shortest(step, seconds), shortest(lambda: field.predict(many), seconds / 2)


def time_torch(variant: Variant, config: FieldConfig, seconds: float) -> tuple[float, float]:
    """Times of a step and of inference [s], with torch's own fused Adam."""
    torch.set_num_threads(variant.threads)
    network = FieldNetwork(config)
    optimizer = torch.optim.Adam(
        network.parameters(), lr=1e-6, betas=ADAM_BETAS, eps=ADAM_EPSILON, fused=True
    )
    rays = random_rays()
    origins = rays.origins.clone().requires_grad_(True)
    directions = rays.directions.clone().requires_grad_(True)

    def values(inputs: torch.Tensor) -> torch.Tensor:
        # The angles of the embedding stay in single precision; bfloat16 would destroy them.
        encoded = network.encoding(inputs)
        with (
            torch.autocast("cpu", torch.bfloat16) if variant.bfloat16 else contextlib.nullcontext()
        ):
            hidden = torch.relu(network.layer1(encoded))
            hidden = torch.relu(network.layer2(hidden))
            hidden = torch.relu(network.layer3(torch.cat([hidden, encoded], dim=-1)))
            output = network.head(torch.relu(network.layer4(hidden))).float()
        return torch.cat([output[:, :1], torch.sigmoid(output[:, 1:])], dim=-1)

    def step() -> None:
        points = origins[:, None] + rays.along_m[..., None] * directions[:, None]
        outputs = values(points.reshape(-1, 3)).reshape(RAYS, -1, 4)
        rendering = render(outputs[..., 0], outputs[..., 1:], rays.along_m, config)
        losses = ray_losses(
            outputs[..., 0],
            rays.along_m,
            rendering,
            rays.distances_m,
            rays.colors,
            config,
            MAPPING,
        )
        losses.total.mean().backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        origins.grad = directions.grad = None

    many = torch.from_numpy(random_points(INFERENCE_POINTS))

    def infer() -> None:
        with torch.inference_mode():
            for batch in many.split(STEP_POINTS):
                values(batch)

    return shortest(step, seconds), shortest(infer, seconds / 2)


def measure(index: int, seconds: float) -> list[Timing]:
    """All widths of one variant, in this process."""
    variant = variants()[index]
    measure_one = time_kernel if variant.isa else time_torch
    timings = []
    for width in WIDTHS:
        step, inference = measure_one(variant, FieldConfig(width=width), seconds)
        timings.append(
            Timing(variant.name, width, variant.threads, 1e3 * step, INFERENCE_POINTS / inference)
        )
    return timings


def measure_in_processes(rounds: int, seconds: float) -> list[Timing]:
    """Every variant in its own process, in turn, `rounds` times; the best of each."""
    best: dict[tuple[str, int, int], Timing] = {}
    for _ in range(rounds):
        for index, variant in enumerate(variants()):
            command = [sys.executable, __file__, "--only", str(index), "--seconds", str(seconds)]
            environment = {**os.environ, **dict(variant.environment)}
            answer = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE)
            for fields in json.loads(answer.stdout):
                timing = Timing(**fields)
                key = (timing.variant, timing.threads, timing.width)
                other = best.get(key, timing)
                best[key] = Timing(
                    timing.variant,
                    timing.width,
                    timing.threads,
                    min(timing.step_ms, other.step_ms),
                    max(timing.inference_points_per_s, other.inference_points_per_s),
                )
    return list(best.values())


def machine() -> str:
    """Processor and versions, for people."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        model = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), model)
    best = available_isas()[0]
    return f"{model}, {os.cpu_count()} cores, {best}; torch {torch.__version__}"


def speedups(timings: Sequence[Timing]) -> dict[str, float]:
    """The comparisons that decide: steps of torch over steps of the kernel, two threads each."""
    step = {(t.variant, t.threads, t.width): t.step_ms for t in timings}
    result = {}
    for width in WIDTHS:
        best = min(step["torch fp32", 2, width], step["torch bf16 autocast", 2, width])
        kernel = min(ms for (name, _, w), ms in step.items() if w == width and "kernel" in name)
        result[f"width {width}: best torch / best kernel"] = best / kernel
        if ("kernel avx2", 2, width) in step:
            avx2 = step["kernel avx2", 2, width]
            result[f"width {width}: torch fp32 / kernel avx2"] = step["torch fp32", 2, width] / avx2
            result[f"width {width}: torch fp32 with AVX2 only / kernel avx2"] = (
                step["torch fp32, AVX2 only", 2, width] / avx2
            )
    return result


def table_of(timings: Sequence[Timing]) -> Table:
    table = Table(title=f"Training step of {STEP_POINTS} points, and inference")
    table.add_column("variant")
    table.add_column("threads", justify="right")
    for width in WIDTHS:
        table.add_column(f"step {width} [ms]", justify="right")
    for width in WIDTHS:
        table.add_column(f"infer {width} [M/s]", justify="right")
    rows: dict[tuple[str, int], dict[int, Timing]] = {}
    for timing in timings:
        rows.setdefault((timing.variant, timing.threads), {})[timing.width] = timing
    for (name, threads), widths in rows.items():
        steps = [f"{widths[w].step_ms:.2f}" for w in WIDTHS]
        inference = [f"{widths[w].inference_points_per_s / 1e6:.2f}" for w in WIDTHS]
        table.add_row(name, str(threads), *steps, *inference)
    return table


def plot(timings: Sequence[Timing], path: Path) -> None:
    """Bars of the steps, one panel a width."""
    figure, axes = plt.subplots(1, len(WIDTHS), figsize=(13, 5), layout="constrained")
    for axis, width in zip(axes, WIDTHS, strict=True):
        chosen = sorted((t for t in timings if t.width == width), key=lambda t: -t.step_ms)
        labels = [f"{t.variant} ({t.threads} thr.)" for t in chosen]
        colors = ["tab:orange" if "torch" in t.variant else "tab:blue" for t in chosen]
        bars = axis.barh(labels, [t.step_ms for t in chosen], color=colors)
        axis.bar_label(bars, fmt="%.1f", padding=3)
        axis.set(title=f"width {width}", xlabel="training step [ms]", xscale="log")
        axis.margins(x=0.2)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"Training step of {STEP_POINTS} points")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def write_table(table: Table, ratios: dict[str, float], path: Path) -> None:
    with path.open("w") as file:
        console = Console(file=file, width=140, markup=False)
        file.write("Made by `python benchmarks/kernel_throughput.py`\n\n")
        file.write(f"{machine()}\n\n")
        console.print(table)
        for name, ratio in ratios.items():
            file.write(f"{name}: {ratio:.1f}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--rounds", type=int, default=3, help="processes a variant")
    parser.add_argument("--seconds", type=float, default=1.0, help="of repetition a figure")
    parser.add_argument("--only", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only is not None:
        print(json.dumps([asdict(t) for t in measure(options.only, options.seconds)]))
        return
    timings = measure_in_processes(options.rounds, options.seconds)
    ratios = speedups(timings)
    table = table_of(timings)
    console = Console(markup=False)
    console.print(table)
    for name, ratio in ratios.items():
        console.print(f"{name}: {ratio:.1f}")
    options.out.mkdir(parents=True, exist_ok=True)
    stem = options.out / "kernel_throughput"
    write_table(table, ratios, stem.with_suffix(".txt"))
    plot(timings, stem.with_suffix(".png"))
    result = {
        "machine": machine(),
        "step_points": STEP_POINTS,
        "timings": [asdict(timing) for timing in timings],
        "speedups": ratios,
    }
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
