"""ROS domains of the test session's own, on this computer alone."""

from __future__ import annotations

import os

from meslam_ros.domains import LAST_DOMAIN, taken_domains

PAIRS = LAST_DOMAIN // 2


def _two_domains() -> tuple[int, int]:
    """Two domains that nobody uses."""
    taken = taken_domains()
    first = os.getpid() % PAIRS
    pairs = [(1 + 2 * ((first + n) % PAIRS), 2 + 2 * ((first + n) % PAIRS)) for n in range(PAIRS)]
    return next((pair for pair in pairs if not taken.intersection(pair)), pairs[0])


DOMAIN, OTHER_DOMAIN = _two_domains()


def enter() -> None:
    """Choose the domain for this process and all it starts; before rclpy is initialised."""
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
