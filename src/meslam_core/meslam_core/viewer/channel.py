"""Messages between two processes: a JSON object and blocks of bytes, over a socket."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
from typing import Any

_LENGTH = struct.Struct("<I")
_SIZES = "blocks"


class Channel:
    """One end of a connected stream socket; one thread at a time may use it."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._stream = connected.makefile("rwb")

    def send(self, header: dict[str, Any], *blocks: bytes) -> None:
        """Send one message.

        Raises:
            OSError: when the other end is gone.
        """
        text = json.dumps(header | {_SIZES: [len(block) for block in blocks]}).encode()
        for part in (_LENGTH.pack(len(text)), text, *blocks):
            self._stream.write(part)
        self._stream.flush()

    def receive(self) -> tuple[dict[str, Any], list[bytes]]:
        """The next message: its JSON object and its blocks.

        Raises:
            EOFError: when the other end is gone.
        """
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        header = json.loads(self._read(length))
        return header, [self._read(size) for size in header.pop(_SIZES)]

    def hang_up(self) -> None:
        """Let both ends see that there will be nothing more; from any thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _read(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) < size:
            raise EOFError("the other process has ended")
        return data
