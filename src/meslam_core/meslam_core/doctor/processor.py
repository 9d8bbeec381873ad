"""What computes: the compiled kernel, the processor's instructions and cores, torch and a GPU."""

from __future__ import annotations

import importlib
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from meslam_core.doctor.finding import Finding, fail, ok, warn
from meslam_core.doctor.packages import SET_UP

# Tracking and mapping each keep one core busy.
WORKERS = 2
CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
# With any of these, OpenMP binds the main thread to a core, and all others inherit that.
PINNING = ("OMP_PROC_BIND", "GOMP_CPU_AFFINITY", "KMP_AFFINITY", "OMP_PLACES")
ISA = "MESLAM_KERNEL_ISA"
ISA_NAMES = {
    "amx": "AMX",
    "avx512bf16": "AVX-512 with bfloat16",
    "avx512": "AVX-512",
    "avx2": "AVX2",
}
PORTABLE = "portable"


def examine_processor() -> Iterator[Finding]:
    """Kernel, cores, threads, torch and GPU."""
    yield kernel()
    yield cores(usable_cores(), os.cpu_count() or 1)
    yield thread_binding(os.environ)
    yield torch_and_gpu()


def kernel() -> Finding:
    """Whether the compiled kernel is there, and which instructions it uses."""
    try:
        from meslam_core.errors import ConfigError
        from meslam_core.field import kernel as compiled
    except ImportError as error:
        return fail("kernel", f"cannot be loaded: {error}", SET_UP)
    try:
        return kernel_path(compiled.unavailable_reason(), compiled.available_isas(), os.environ)
    except ConfigError as error:
        return fail("kernel", str(error), f"run `unset {ISA}`")


def kernel_path(reason: str, isas: Sequence[str], environment: Mapping[str, str]) -> Finding:
    """Judge the kernel.

    Args:
        reason: why it is not there; empty where it is.
        isas: instruction sets that it can use, the best first.
        environment: of the process.
    """
    if reason:
        remedy = (
            "install a C++ compiler and the headers of Python (`apt-get install g++ python3-dev`), "
            "then run `make build`; without the kernel mapping is ten times as slow"
        )
        return fail("kernel", reason, remedy)
    best = isas[0] if isas else PORTABLE
    told = f"built, uses {ISA_NAMES.get(best, best)}"
    if environment.get(ISA):
        remedy = f"run `unset {ISA}` to use the best that the processor has"
        return warn("kernel", f"{told}, as {ISA}={environment[ISA]} says", remedy)
    if best not in ISA_NAMES and platform.machine() == "x86_64":
        remedy = "use a processor with AVX2 (2013 or later), or a virtual machine that shows it"
        return warn("kernel", f"{told}: this processor shows no AVX2, so it is slow", remedy)
    return ok("kernel", told)


def usable_cores(quota: Path = CPU_QUOTA) -> float:
    """Cores that this process may use: by affinity, and by the container's quota."""
    allowed = float(
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    try:
        limit, period = quota.read_text().split()
        return min(allowed, float(limit) / float(period))
    except (OSError, ValueError):
        # No control group, or "max": no limit.
        return allowed


def cores(usable: float, there: int) -> Finding:
    """Whether tracking and mapping have a core each."""
    told = f"{usable:g} of {there} usable"
    if usable >= WORKERS:
        return ok("cores", told)
    remedy = (
        f"give the process {WORKERS} cores (`docker run --cpus {WORKERS}`), or use a lower rate of "
        "the camera and fewer `mapping.iterations`"
    )
    return warn("cores", f"{told}: tracking and mapping want one each", remedy)


def thread_binding(environment: Mapping[str, str]) -> Finding:
    """Whether OpenMP is told to put all threads on one core."""
    bound = [f"{name}={environment[name]}" for name in PINNING if environment.get(name)]
    bound = [each for each in bound if not each.lower().endswith("=false")]
    if not bound:
        return ok("threads", "not bound to cores")
    remedy = f"run `unset {' '.join(each.split('=')[0] for each in bound)}`"
    told = f"{', '.join(bound)} may bind tracking and mapping to the same core"
    return warn("threads", told, remedy)


def torch_and_gpu() -> Finding:
    """Whether torch can be loaded, and whether it sees a GPU."""
    try:
        torch = importlib.import_module("torch")
    except (ImportError, OSError) as error:
        return fail("torch", f"cannot be loaded: {error}", SET_UP)
    if torch.cuda.is_available():
        return ok("torch", f"{torch.__version__}, sees {torch.cuda.get_device_name()}")
    return ok("torch", f"{torch.__version__}, no GPU; none is needed")
