"""Places that are hard to write to: full, read-only, somebody else's."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

from faults.fault import SkippedError

NOBODY = 65534
FILLING = "filling"


@contextlib.contextmanager
def small_disk(place: Path, size_kb: int) -> Iterator[Path]:
    """A file system of its own with so much room; needs root."""
    place.mkdir(parents=True)
    _mount("-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(place))
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=False)


@contextlib.contextmanager
def read_only(place: Path) -> Iterator[Path]:
    """A folder as on a disk that is mounted read-only; needs root."""
    _mount("--bind", str(place), str(place))
    try:
        _mount("-o", "remount,ro,bind", str(place))
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=False)


def fill(disk: Path, left_kb: int) -> None:
    """Leave only so much room on a disk."""
    room = os.statvfs(disk)
    taken = room.f_bavail * room.f_frsize - left_kb * 1024
    (disk / FILLING).write_bytes(b"\1" * max(taken, 0))


def become_nobody() -> Callable[[], None]:
    """For a new process: go on as a user without any right; needs root."""
    if os.getuid() != 0:
        raise SkippedError("only root may become another user")

    def become() -> None:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)

    return become


def _mount(*arguments: str) -> None:
    if os.getuid() != 0:
        raise SkippedError("only root may mount a file system")
    mounted = subprocess.run(["mount", *arguments], check=False, capture_output=True, text=True)
    if mounted.returncode != 0:
        raise SkippedError(f"this machine does not mount: {mounted.stderr.strip()}")
