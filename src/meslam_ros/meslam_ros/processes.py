"""Nodes as processes of their own, which end with the program that started them."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PR_SET_PDEATHSIG = 1
STOPPING_S = 10.0


def ros_arguments(parameters: Mapping[str, Any], extra: Sequence[str] = ()) -> list[str]:
    """Command-line arguments that set parameters; `extra` follows, such as remappings."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={_yaml(value)}"]
    return [*arguments, *extra] if parameters or extra else []


def _yaml(value: Any) -> str:
    """A value as YAML; texts are quoted, for they may be empty or look like numbers."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return str(value)
    return "'" + str(value).replace("'", "''") + "'"


class NodeProcess:
    """A node of this package in a process of its own.

    Ctrl-C in the terminal does not reach it: whoever started it decides when it ends. When the
    starter dies, the kernel ends it (Linux).

    Args:
        name: of the node.
        arguments: for it.
        environment: of the process; by default this one's.
        log: file for its output; by default it goes where this program's goes.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        log: Path | None = None,
    ) -> None:
        self.name = name
        self.log = log
        command = [sys.executable, "-m", f"meslam_ros.{name}", *arguments]
        output = log.open("ab") if log else None
        try:
            self._process = subprocess.Popen(
                command,
                env=None if environment is None else dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT if output else None,
                process_group=0,
                preexec_fn=_die_with_parent,
            )
        finally:
            if output:
                output.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs."""
        return self._process.poll()

    def wait(self, timeout_s: float) -> int | None:
        """The exit status, or None when it still runs after the time."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, unless it has ended."""
        if self.status is None:
            self._process.send_signal(number)

    def stop(self, timeout_s: float = STOPPING_S) -> int:
        """Ask it to end, insist after a while; the exit status."""
        # Python ends silently on SIGTERM while it still imports; on SIGINT it shows a traceback.
        self.signal(signal.SIGTERM)
        status = self.wait(timeout_s)
        if status is None:
            self._process.kill()
            status = self._process.wait()
        return status

    def output(self) -> str:
        """What it has written to its log."""
        return self.log.read_text(errors="replace") if self.log else ""


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
