"""`slam_node`: all four nodes at once, each in a process of its own."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

NODES = ("map_server_node", "region_manager_node", "odometry_node", "tracking_node")
MAX_RESTARTS = 3
RESTART_WINDOW_S = 60.0
POLL_S = 0.1
STOPPING_S = 10.0
USAGE_ERROR = 2
PR_SET_PDEATHSIG = 1


def child_arguments(arguments: Sequence[str]) -> list[str]:
    """The arguments that all nodes get: those given, but for a name, which would be everyone's."""
    kept: list[str] = []
    skip = False
    for position, argument in enumerate(arguments):
        following = arguments[position + 1] if position + 1 < len(arguments) else ""
        if skip:
            skip = False
        elif argument in ("-r", "--remap") and following.startswith("__node:="):
            skip = True
        elif not argument.startswith("__node:="):
            kept.append(argument)
    return kept


def die_with_parent() -> None:
    """Make the kernel end this process when its parent ends, however that happens (Linux)."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass
class Child:
    """One node's process.

    Attributes:
        name: of the node.
        arguments: for it.
        process: that runs.
        restarts: times of the latest ones, `time.monotonic` [s].
    """

    name: str
    arguments: list[str]
    process: subprocess.Popen[bytes] | None = None
    restarts: list[float] = field(default_factory=list)

    def start(self) -> None:
        """Start the process, in a group of its own so that Ctrl-C reaches the parent alone."""
        command = [sys.executable, "-m", f"meslam_ros.{self.name}", *self.arguments]
        self.process = subprocess.Popen(
            command, process_group=0, preexec_fn=die_with_parent, stdin=subprocess.DEVNULL
        )

    @property
    def status(self) -> int | None:
        """Exit status; None while it runs."""
        return self.process.poll() if self.process else None

    def may_restart(self) -> bool:
        """Whether it has not crashed too often lately; counts the restart."""
        now = time.monotonic()
        self.restarts = [t for t in self.restarts if now - t < RESTART_WINDOW_S] + [now]
        return len(self.restarts) <= MAX_RESTARTS


class Supervisor:
    """Starts the nodes, restarts those that crash, and ends them all."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self._children = [Child(name, child_arguments(arguments)) for name in NODES]
        self._stopping = False

    def stop(self, *_: object) -> None:
        """End at the next opportunity; a signal handler."""
        self._stopping = True

    def run(self) -> int:
        """Run until a signal, or a node that cannot be kept running; the exit status."""
        status = 0
        try:
            for child in self._children:
                child.start()
            while not self._stopping and status == 0:
                time.sleep(POLL_S)
                status = self._check()
        finally:
            self._end()
        return status

    def _check(self) -> int:
        """Restart what crashed; the status to end with, 0 to go on."""
        for child in self._children:
            if child.status is None:
                continue
            if child.status == USAGE_ERROR:
                return USAGE_ERROR
            if child.status == 0:
                say(f"{child.name} has ended, so everything ends")
                return 1
            if not child.may_restart():
                say(f"{child.name} crashed {MAX_RESTARTS + 1} times within a minute; giving up")
                return 1
            say(f"{child.name} crashed with status {child.status}; starting it again")
            child.start()
        return 0

    def _end(self) -> None:
        """Ask all nodes to end, and insist after a while."""
        running = [c.process for c in self._children if c.process and c.status is None]
        for process in running:
            process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + STOPPING_S
        for process in running:
            try:
                process.wait(max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def say(message: str) -> None:
    """A message for people."""
    print(f"[slam_node] {message}", file=sys.stderr, flush=True)


def main() -> None:
    """Entry point."""
    supervisor = Supervisor(sys.argv[1:])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, supervisor.stop)
    sys.exit(supervisor.run())


if __name__ == "__main__":
    main()
