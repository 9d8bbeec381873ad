"""Where a fault works: a folder of its own, recordings and a map to spoil, and the command."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

MESLAM = (sys.executable, "-c", "from meslam_core.cli import main; main()")
EXPLAINED = (0, 2, 3, 130)
"""What the command's exit status may be."""


@dataclass(frozen=True)
class Ended:
    """How a process ended; a negative status is the signal that ended it."""

    status: int
    stdout: str
    stderr: str

    @property
    def unexplained(self) -> str:
        """Why its end explains nothing to a user; empty where it does."""
        if self.status < 0:
            return f"ended by {signal.Signals(-self.status).name}"
        if "Traceback (most recent call last)" in self.stderr:
            return f"traceback: {self.stderr.strip().splitlines()[-1]}"
        if self.status not in EXPLAINED:
            return f"exit status {self.status}"
        return "" if self.status == 0 or self.message else f"exit status {self.status} in silence"

    @property
    def lines(self) -> list[str]:
        """The lines for people on standard error."""
        own = [line for line in self.stderr.splitlines() if line.startswith(("meslam: ", "Error"))]
        return [line.removeprefix("meslam: ") for line in own]

    @property
    def message(self) -> str:
        """The last line for people on standard error; empty where there is none."""
        return self.lines[-1] if self.lines else ""


class Bench:
    """What a fault may use.

    Attributes:
        folder: its own; empty at first, removed when all went well.
        cache: what faults share, made once.
        data: real recordings; None where there are none.
    """

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder = folder
        self.cache = cache
        data = os.environ.get("MESLAM_DATA")
        self.data = Path(data) if data else None

    def copy(self, shared: Path, name: str = "") -> Path:
        """A copy of a shared file or folder, to be spoilt."""
        target = self.folder / (name or shared.name)
        if shared.is_dir():
            return Path(shutil.copytree(shared, target))
        return Path(shutil.copyfile(shared, target))

    def meslam(
        self,
        *arguments: object,
        environment: Mapping[str, str] | None = None,
        before: Callable[[], None] | None = None,
        during: Callable[[subprocess.Popen[str]], None] | None = None,
    ) -> Ended:
        """Run the command in a process of its own, to its end.

        Args:
            arguments: of the command line.
            environment: added to this one's.
            before: called in the new process, before the command.
            during: called in this one while the command runs.
        """
        process = subprocess.Popen(
            [*MESLAM, *map(str, arguments)],
            cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", **(environment or {})},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            preexec_fn=before,
        )
        try:
            if during is not None:
                during(process)
            stdout, stderr = process.communicate()
        finally:
            process.kill()
        return Ended(process.returncode, stdout, stderr)


def wait_for(condition: Callable[[], object], what: str, limit_s: float = 150.0) -> None:
    """Wait until something holds; time in which this process was stopped does not count.

    Raises:
        TimeoutError: when it never does.
    """
    waited_s, looked = 0.0, time.monotonic()
    while not condition():
        now = time.monotonic()
        waited_s, looked = waited_s + min(now - looked, 1.0), now
        if waited_s > limit_s:
            raise TimeoutError(f"{what} did not happen within {limit_s:.0f} s")
        time.sleep(0.02)
