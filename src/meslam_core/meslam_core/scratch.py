"""Records in an unnamed file: what rests on disk while a program runs."""

from __future__ import annotations

import os
import tempfile
import threading
from dataclasses import dataclass

from meslam_core.errors import OutputError


@dataclass(frozen=True)
class Record:
    """Where a record lies in its file.

    Attributes:
        offset, size: [bytes].
    """

    offset: int
    size: int


class ScratchFile:
    """Byte records on disk that live as long as the object does.

    The file has no name: nothing is left behind however the program ends. A record is written in
    full before anybody knows of it and never overwritten while it is held, so that a failed write
    loses nothing. Any thread may write and read.

    Args:
        folder: of the file; empty for the system's temporary folder.

    Raises:
        OutputError: when the folder cannot be written to.
    """

    def __init__(self, folder: str = "") -> None:
        self._folder = folder or tempfile.gettempdir()
        try:
            os.makedirs(self._folder, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._cannot_write(error) from error
        self._end = 0
        self._free: dict[int, list[int]] = {}
        self._lock = threading.Lock()

    def put(self, *parts: bytes | memoryview) -> Record:
        """Write the parts one after the other as one record.

        Raises:
            OutputError: when the disk is full or fails; nothing has changed.
        """
        data = b"".join(parts)
        record = self._allocate(len(data))
        try:
            written = 0
            while written < len(data):
                rest = memoryview(data)[written:]
                written += os.pwrite(self._file.fileno(), rest, record.offset + written)
        except OSError as error:
            self.release(record)
            raise self._cannot_write(error) from error
        return record

    def get(self, record: Record) -> bytes:
        """The bytes of a record.

        Raises:
            OutputError: when the disk fails.
        """
        parts, read = [], 0
        try:
            while read < record.size:
                part = os.pread(self._file.fileno(), record.size - read, record.offset + read)
                if not part:
                    raise OSError(5, "the file is shorter than what was written to it")
                parts.append(part)
                read += len(part)
        except OSError as error:
            raise self._cannot_write(error) from error
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def release(self, record: Record) -> None:
        """Give the place of a record to a later one of the same size."""
        with self._lock:
            self._free.setdefault(record.size, []).append(record.offset)

    @property
    def size(self) -> int:
        """Bytes that the file takes on disk at most."""
        return self._end

    def _allocate(self, size: int) -> Record:
        with self._lock:
            if free := self._free.get(size):
                return Record(free.pop(), size)
            offset, self._end = self._end, self._end + size
            return Record(offset, size)

    def _cannot_write(self, error: OSError) -> OutputError:
        return OutputError(
            f"{self._folder}: regions at rest cannot be kept there ({error.strerror or error}); "
            "free space, or set runtime.work_dir to another folder"
        )
