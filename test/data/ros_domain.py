"""ROS domains of the test session's own, on this computer alone."""

from __future__ import annotations

import os

# Domains above 101 may collide with the ports that Linux hands out to other programs.
DOMAIN = 1 + 2 * (os.getpid() % 50)
OTHER_DOMAIN = DOMAIN + 1


def enter() -> None:
    """Choose the domain for this process and all it starts; before rclpy is initialised."""
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
