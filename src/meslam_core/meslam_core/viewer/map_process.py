"""The viewer's end of the process that asks the networks."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from typing import Any

from meslam_core.errors import MapError
from meslam_core.viewer.channel import Channel


class MapProcess:
    """Starts `map_worker` and asks it; one thread at a time may use it."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "meslam_core.viewer.map_worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                # Ctrl-C in the terminal ends the viewer, which ends this.
                process_group=0,
            )
        self._channel = Channel(ours)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def ask(self, request: dict[str, Any], *blocks: bytes) -> tuple[dict[str, Any], bytes]:
        """Send a request and wait for its answer.

        Raises:
            MapError: when the answer is a refusal.
            EOFError, OSError: when the process has ended.
        """
        self._channel.send(request, *blocks)
        answer, (block,) = self._channel.receive()
        if "error" in answer:
            raise MapError(answer["error"])
        return answer, block

    def close(self) -> None:
        """End it, also in the middle of a request, which another thread may wait for."""
        self._channel.hang_up()
        # It holds nothing that could be lost.
        self._process.kill()
        self._process.wait()
