"""ROS domains that nobody on this computer uses."""

from __future__ import annotations

from pathlib import Path

LAST_DOMAIN = 100
"""Domains above 101 may collide with the ports that Linux hands out to other programs."""

_SHARED_MEMORY = Path("/dev/shm")
_PORT_FILE = "fastrtps_port"
_FIRST_PORT, _PORTS_A_DOMAIN = 7400, 250


def taken_domains(folder: Path = _SHARED_MEMORY) -> set[int]:
    """Domains in whose shared-memory ports a process sits, or one that was killed.

    Fast DDS does not always notice that a port's owner is gone; whoever gets that port then hears
    nothing.

    Args:
        folder: where Fast DDS keeps its ports.
    """
    ports = [file.name.removeprefix(_PORT_FILE) for file in folder.glob(f"{_PORT_FILE}*")]
    return {(int(port) - _FIRST_PORT) // _PORTS_A_DOMAIN for port in ports if port.isdigit()}


def free_domain(number: int, taken: set[int] | None = None) -> int:
    """A domain from 1 to LAST_DOMAIN that is not taken, as far as there is one.

    Args:
        number: chooses among them, a process's own number for example.
        taken: domains to keep clear of; None for those of this computer.
    """
    taken = taken_domains() if taken is None else taken
    candidates = [1 + (number + n) % LAST_DOMAIN for n in range(LAST_DOMAIN)]
    return next((domain for domain in candidates if domain not in taken), candidates[0])
