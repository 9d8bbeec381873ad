"""Files that are either whole or not there, whatever happens while they are written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from meslam_core.errors import OutputError

TEMPORARY_SUFFIX = ".tmp"


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that a crash at any instant leaves its old content or the new.

    Raises:
        OSError: when the place cannot be written; nothing is left behind.
    """
    produce_atomically(path, lambda file: _write(file, data))


def produce_atomically(path: Path, produce: Callable[[BinaryIO], None]) -> None:
    """As `write_atomically`, with the content written by a function."""
    temporary = path.with_name(path.name + TEMPORARY_SUFFIX)
    try:
        with open(temporary, "wb") as file:
            produce(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Make renames and deletions in a folder durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The error for people when a place cannot be written."""
    return OutputError(
        f"{path} cannot be written: {error.strerror or error}; "
        "choose another place, or free space and check permissions"
    )


def _write(file: BinaryIO, data: bytes) -> None:
    file.write(data)
