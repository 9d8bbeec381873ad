"""ROS domains of the test session's own, on this computer alone."""

from __future__ import annotations

import os
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
PORT_FILE = "fastrtps_port"
FIRST_PORT, PORTS_A_DOMAIN = 7400, 250
# Domains above 101 may collide with the ports that Linux hands out to other programs.
PAIRS = 50


def _two_domains() -> tuple[int, int]:
    """Two domains in whose shared-memory ports no process sits, nor one that was killed.

    Fast DDS does not always notice that a port's owner is gone; whoever gets that port then hears
    nothing.
    """
    ports = [file.name.removeprefix(PORT_FILE) for file in SHARED_MEMORY.glob(f"{PORT_FILE}*")]
    taken = {(int(port) - FIRST_PORT) // PORTS_A_DOMAIN for port in ports if port.isdigit()}
    first = os.getpid() % PAIRS
    pairs = [(1 + 2 * ((first + n) % PAIRS), 2 + 2 * ((first + n) % PAIRS)) for n in range(PAIRS)]
    return next((pair for pair in pairs if not taken.intersection(pair)), pairs[0])


DOMAIN, OTHER_DOMAIN = _two_domains()


def enter() -> None:
    """Choose the domain for this process and all it starts; before rclpy is initialised."""
    os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
