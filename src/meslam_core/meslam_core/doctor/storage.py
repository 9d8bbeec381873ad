"""Room for a run: memory, and disk where its results go."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from meslam_core.doctor.finding import Finding, fail, ok, warn

MEGABYTE = 1e6
# A run of one region takes 0.5 GB, a building 0.7 GB.
LEAST_MEMORY_MB, WANTED_MEMORY_MB = 800.0, 1500.0
# A map takes kilobytes; a simulated or converted recording 1 GB a minute.
LEAST_DISK_MB, WANTED_DISK_MB = 100.0, 2000.0
MEMORY = Path("/proc/meminfo")
MEMORY_LIMIT, MEMORY_USED = (
    Path("/sys/fs/cgroup") / name for name in ("memory.max", "memory.current")
)


def examine_storage(folder: Path) -> Iterator[Finding]:
    """Memory, and the folder of results."""
    yield memory(free_memory_mb())
    yield disk(folder)


def free_memory_mb(
    known: Path = MEMORY, limit: Path = MEMORY_LIMIT, used: Path = MEMORY_USED
) -> float | None:
    """What a process can still get [MB]: of the machine, and of the container; None if unknown."""
    try:
        lines = dict(line.split(":", 1) for line in known.read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024 / MEGABYTE
    except (OSError, KeyError, ValueError):
        return None
    try:
        return min(free, (int(limit.read_text()) - int(used.read_text())) / MEGABYTE)
    except (OSError, ValueError):
        # No control group, or "max": no limit.
        return free


def memory(free_mb: float | None) -> Finding:
    """Whether a run fits."""
    if free_mb is None:
        return ok("memory", "cannot be told on this system")
    told = f"{free_mb / 1000:.1f} GB free"
    remedy = "end other programs, or give the container more (`docker run --memory`)"
    if free_mb < LEAST_MEMORY_MB:
        return fail("memory", f"{told}; a run takes 0.5 to 0.7 GB", remedy)
    if free_mb < WANTED_MEMORY_MB:
        return warn("memory", f"{told}; viewers and recordings want some beside the run", remedy)
    return ok("memory", told)


def disk(folder: Path) -> Finding:
    """Whether results can be written to a folder, which need not be there yet."""
    subject = "disk"
    present = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if not present.is_dir() or not os.access(present, os.W_OK | os.X_OK):
        remedy = "choose another one: `meslam run RECORDING --out FOLDER`"
        return fail(subject, f"{present.absolute()} is no folder that can be written", remedy)
    free_mb = shutil.disk_usage(present).free / MEGABYTE
    told = f"{free_mb / 1000:.1f} GB free in {present.absolute()}"
    remedy = "free some space, or choose a folder on another disk"
    if free_mb < LEAST_DISK_MB:
        return fail(subject, told, remedy)
    if free_mb < WANTED_DISK_MB:
        return warn(subject, f"{told}; recordings take about 1 GB a minute", remedy)
    return ok(subject, told)
