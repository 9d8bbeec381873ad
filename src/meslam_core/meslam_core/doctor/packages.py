"""Whether Python and the packages are those that MeSLAM was tested with."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path

import meslam_core
from meslam_core.doctor.finding import Finding, fail, ok, warn

PYTHONS = ((3, 11), (3, 12))
# Without these something else than the method is missing.
OPTIONAL = {
    "pyrealsense2": "RealSense cameras and librealsense's recordings",
    "matplotlib": "pictures of results",
}
SET_UP = "run `make setup` in the folder of MeSLAM, then `source env.bash`"

Installed = Callable[[str], str]


def examine_packages() -> Iterator[Finding]:
    """Python, and every pinned package."""
    yield python_version(sys.version_info[:2])
    yield from pinned_packages(pins(), metadata.version)


def python_version(version: tuple[int, int]) -> Finding:
    """Whether the interpreter is one that was tested."""
    told = ".".join(map(str, version))
    if version in PYTHONS:
        return ok("Python", f"{told}, {sys.executable}")
    names = " or ".join(".".join(map(str, each)) for each in PYTHONS)
    remedy = f"install Python {names} and run `MESLAM_PYTHON=/path/to/python make setup`"
    return (warn if version > PYTHONS[-1] else fail)("Python", f"{told} is not tested", remedy)


def pins(requirements: Path | None = None) -> dict[str, str]:
    """Versions by package, from requirements.txt beside the sources; empty without sources."""
    path = requirements or Path(meslam_core.__file__).resolve().parents[3] / "requirements.txt"
    if not path.is_file():
        return {}
    return dict(re.findall(r"^([\w.-]+)==([\w.]+)", path.read_text(), re.MULTILINE))


def pinned_packages(wanted: Mapping[str, str], installed: Installed) -> Iterator[Finding]:
    """Every package that is missing or another version, or one line that all is well."""
    if not wanted:
        yield ok("packages", "not compared: requirements.txt is not beside the installed package")
        return
    faults = [fault for name in wanted if (fault := _fault(name, wanted[name], installed))]
    yield from faults
    if not faults:
        yield ok("packages", f"all {len(wanted)} are the pinned versions")


def _fault(name: str, version: str, installed: Installed) -> Finding | None:
    try:
        found = installed(name)
    except metadata.PackageNotFoundError:
        if name in OPTIONAL:
            return warn(name, f"is not installed; needed for {OPTIONAL[name]}", SET_UP)
        return fail(name, "is not installed", SET_UP)
    # A build for certain hardware adds its name: 2.13.0+cpu.
    if found.split("+")[0] == version:
        return None
    remedy = f"run `python -m pip install {name}=={version}`, or {SET_UP}"
    return warn(name, f"{found} is installed, {version} was tested", remedy)
