"""Runs faults, each in a process of its own with a limit on its time, and judges what it saw."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from faults.catalogue import home_of
from faults.fault import Fault
from faults.injection import BEGUN, RESULT, Result, Verdict
from faults.kept_maps import lost_maps

TEST_FOLDER = Path(__file__).resolve().parents[1]
POLL_S = 0.05
# A machine that does other work is slower than the one the limits are made for.
PATIENCE = 3.0
STARTING_S = 100.0


class Trial:
    """A fault that is running in a process of its own.

    Args:
        fault: what.
        folder: for what it makes; emptied first.
        cache: what faults share.
        module: that lists the fault; by default it is looked for in the catalogue.
    """

    def __init__(self, fault: Fault, folder: Path, cache: Path, module: str = "") -> None:
        self.fault = fault
        self._folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "bench").mkdir(parents=True)
        home = module or home_of(fault)
        with (folder / "output.txt").open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "faults.injection", fault.name, folder, cache, home],
                cwd=folder,
                env={**os.environ, "PYTHONPATH": _python_path(), "OMP_NUM_THREADS": "1"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        self._started = self._looked = time.monotonic()
        self._begun = False
        self._own_s = 0.0

    def poll(self) -> Result | None:
        """What came of it, as soon as it is known."""
        now = time.monotonic()
        # Time in which this process was stopped itself is nobody's.
        self._own_s += min(now - self._looked, 1.0)
        self._looked = now
        if self._process.poll() is None:
            if not self._begun and (self._folder / BEGUN).exists():
                self._begun, self._own_s = True, 0.0
            if self._own_s < PATIENCE * (self.fault.limit_s if self._begun else STARTING_S):
                return None
            self.stop()
            return self._judged(f"hang: still running after {self._own_s:.0f} s")
        # What it started must not outlive it.
        self.stop()
        return self._judged("")

    def stop(self) -> None:
        """End the process and all that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def wait(self) -> Result:
        """What came of it."""
        while (result := self.poll()) is None:
            time.sleep(POLL_S)
        return result

    def _judged(self, problem: str) -> Result:
        seen, verdict = "", Verdict.AS_EXPECTED
        file = self._folder / RESULT
        status = self._process.returncode
        if not problem and status != 0:
            ended = signal.Signals(-status).name if status < 0 else f"exit status {status}"
            problem = f"unexplained exit: {ended}"
        if not problem and not file.exists():
            problem = "unexplained exit: it told nothing"
        if file.exists():
            told = Result.read(file)
            seen, verdict, problem = told.seen, told.verdict, problem or told.problem
        lost = "; ".join(lost_maps(self._folder / "bench", self.fault.harmed))
        problem = "; ".join(filter(None, (problem, lost)))
        if problem:
            verdict = Verdict.MISSED
        else:
            shutil.rmtree(self._folder / "bench", ignore_errors=True)
        result = Result(self.fault.name, verdict, seen, problem, time.monotonic() - self._started)
        result.write(file)
        return result


def _python_path() -> str:
    return os.pathsep.join(filter(None, [str(TEST_FOLDER), os.environ.get("PYTHONPATH")]))
