"""One writer at a time: a folder that a program holds while it writes."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from meslam_core.errors import OutputError

HELD_LOCKS = Path("/proc/locks")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other programs from writing a folder; those that only read it are not hindered.

    The lock is the kernel's (`flock` on the folder itself): it ends with the process that holds
    it, however that ends, so that none is ever left behind. It binds those that ask for it.

    Args:
        folder: exists; it need not be writable.

    Raises:
        OutputError: when another program, or another part of this one, holds it; the message
            names its process.
        OSError: when there is no such folder.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(
                f"{folder} is being written by {_holder(descriptor)}; wait until it is done, or "
                "choose another folder"
            ) from error
        yield
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    """Who holds the lock on an open folder, for people."""
    held = os.fstat(descriptor)
    device = f"{os.major(held.st_dev):02x}:{os.minor(held.st_dev):02x}:{held.st_ino}"
    # A line is `1: FLOCK  ADVISORY  WRITE 4711 08:01:123456 0 EOF` (man 5 proc_locks).
    with contextlib.suppress(OSError, ValueError):
        for line in HELD_LOCKS.read_text().splitlines():
            fields = line.split()
            if len(fields) >= 6 and fields[1] == "FLOCK" and fields[5] == device:
                return f"process {int(fields[4])}{_command(int(fields[4]))}"
    # In another container, or on another computer that shares the disk.
    return "another program"


def _command(process: int) -> str:
    """What a process runs, in brackets; empty where that is not known."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_text(errors="replace").split("\0")
    except OSError:
        return ""
    shown = " ".join(Path(word).name if "/" in word else word for word in words if word)
    return f" ({shown[:60]})" if shown else ""
