"""What a benchmark ran on, for the head of its results."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

# The instruction sets that decide how fast dense linear algebra is, as Linux names them.
INSTRUCTION_SETS = ("amx_bf16", "avx512_bf16", "avx512f", "avx2", "fma", "asimd", "sve")


def machine(libraries: tuple[str, ...] = ()) -> dict[str, Any]:
    """Processor, cores, instruction sets, and versions of Python and of distributions."""
    model, flags = platform.processor() or platform.machine(), ""
    info = Path("/proc/cpuinfo")
    if info.exists():
        entries = [line.split(":", 1) for line in info.read_text().splitlines() if ":" in line]
        known = {name.strip(): value.strip() for name, value in reversed(entries)}
        model = known.get("model name", model)
        flags = known.get("flags", known.get("Features", ""))
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "instruction_sets": [name for name in INSTRUCTION_SETS if name in flags.split()],
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in libraries},
    }


def machine_line(described: dict[str, Any]) -> str:
    """The same on one line."""
    sets = ", ".join(described["instruction_sets"])
    versions = ", ".join(f"{name} {version}" for name, version in described["versions"].items())
    return f"{described['cpu']}, {described['cores']} cores ({sets}); {versions}"


def busy_core_s() -> float:
    """What all cores together have computed for anybody since the machine started [s]."""
    ticks = Path("/proc/stat").read_text().splitlines()[0].split()[1:]
    user, nice, system, _, _, irq, softirq, *rest = map(int, ticks)
    stolen = rest[0] if rest else 0
    return (user + nice + system + irq + softirq + stolen) / os.sysconf("SC_CLK_TCK")


def memory_mb(pid: int) -> tuple[float, float]:
    """Resident set of a process now and at its largest [MB], from Linux's /proc."""
    entries = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    return _megabytes(entries["VmRSS"]), _megabytes(entries["VmHWM"])


def _megabytes(text: str) -> float:
    kibibytes, unit = text.split()
    assert unit == "kB"
    return int(kibibytes) * 1024 / 1e6
