"""Whether ROS 2 is there, and what of it was built."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from meslam_core.doctor import Finding, fail, ok, warn

DISTRIBUTION = "jazzy"
MIDDLEWARE = "rmw_fastrtps_cpp"
# On a loaded computer the first import takes that long.
IMPORT_S = 60.0
SOURCE = "run `source env.bash` in the folder of MeSLAM, after `make setup`"
REBUILD = "run `make build` in the folder of MeSLAM, then `source env.bash`"
# A broken rclpy may end the process that loads it: that must be another one.
PROBE = """
import json
import rclpy
told = {"middleware": rclpy.get_rmw_implementation_identifier()}
try:
    from rclpy.type_support import check_for_type_support
    from meslam_interfaces.msg import TrackingStatus
    check_for_type_support(TrackingStatus)
except Exception as error:
    told["interfaces"] = f"{type(error).__name__}: {error}"
print(json.dumps(told))
"""

Probe = Callable[[], Mapping[str, Any]]


class ProbeError(Exception):
    """rclpy cannot be loaded."""


def examine_installation() -> Iterator[Finding]:
    """Distribution, rclpy, interfaces and middleware."""
    yield distribution(os.environ.get("ROS_DISTRO", ""))
    yield from libraries(probe)


def distribution(name: str) -> Finding:
    """Whether the sourced distribution is the one that was tested."""
    if name == DISTRIBUTION:
        return ok("ROS", f"{name} is sourced")
    if not name:
        return fail("ROS", "no distribution is sourced (ROS_DISTRO is empty)", SOURCE)
    remedy = f"in a new shell {SOURCE}; MeSLAM is tested with {DISTRIBUTION}"
    return warn("ROS", f"{name} is sourced", remedy)


def probe() -> Mapping[str, Any]:
    """Load rclpy and the interfaces in a process of its own, and tell what came of it.

    Raises:
        ProbeError: when rclpy cannot be loaded, or not in time.
    """
    try:
        ended = subprocess.run(
            [sys.executable, "-c", PROBE],
            capture_output=True,
            text=True,
            timeout=IMPORT_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ProbeError(f"loading it takes more than {IMPORT_S:g} s") from error
    if ended.returncode:
        said = ended.stderr.strip().splitlines() or [f"it ends with {ended.returncode}"]
        raise ProbeError(said[-1])
    told: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    return told


def libraries(loaded: Probe) -> Iterator[Finding]:
    """rclpy, the interfaces and the middleware."""
    try:
        told = loaded()
    except ProbeError as error:
        yield fail("rclpy", f"cannot be loaded: {error}", SOURCE)
        return
    yield ok("rclpy", "can be loaded")
    if reason := told.get("interfaces"):
        yield fail("meslam_interfaces", f"cannot be loaded: {reason}", REBUILD)
    else:
        yield ok("meslam_interfaces", "built")
    name = told["middleware"]
    if name == MIDDLEWARE:
        yield ok("middleware", name)
    else:
        remedy = (
            f"run `export RMW_IMPLEMENTATION={MIDDLEWARE}`, or give {name} room for images "
            "yourself: config/fastdds.xml is not read by it"
        )
        yield warn("middleware", f"{name}; tested is {MIDDLEWARE}", remedy)
