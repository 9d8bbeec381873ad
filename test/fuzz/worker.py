"""A process that fuzzes one target, and what becomes of it when a parser takes it down."""

from __future__ import annotations

import faulthandler
import logging
import mmap
import os
import resource
import signal
import struct
import tempfile
import time
import traceback
import warnings
from pathlib import Path

from fuzz.case_file import case_name, read_case, write_case
from fuzz.loop import Finding, Outcome, fuzz
from fuzz.mutation import Parts
from fuzz.target import Target

from meslam_core.threads import limit_threads

MEMORY_BYTES = 1 << 30
"""What parsing one input may take on top of what the process has."""
SILENCE_S = 60.0
"""Native code is not interrupted by the limit on an input's time: this one holds for it."""
POLL_S = 0.2
LONGEST_POLL_S = 1.0
MAX_DEATHS = 5
_COUNTS = struct.Struct("<QQdQ")


def fuzz_in_process(target: Target, seed: int, seconds: float) -> Outcome:
    """Fuzz a target in a process of its own; one that dies or hangs is a finding, too.

    Args:
        target: to fuzz.
        seed: of all random choices.
        seconds: of processor time [s].
    """
    total = Outcome()
    for deaths in range(MAX_DEATHS):
        part, died = _run_child(target, f"{seed} {deaths}", seconds - total.seconds)
        total.add(part)
        if not died:
            break
    return total


def _run_child(target: Target, seed: str, seconds: float) -> tuple[Outcome, bool]:
    """What a child came to, and whether it died of an input."""
    counts = mmap.mmap(-1, _COUNTS.size)
    with tempfile.TemporaryDirectory(prefix="fuzzing-") as name, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads
        folder = Path(name)
        process = os.fork()
        if process == 0:
            try:
                _work(target, seed, seconds, counts, folder)
                os._exit(0)
            except BaseException:
                (folder / "log").write_text(traceback.format_exc())
                os._exit(1)
        status, elapsed_s = _watched(process, counts)
        outcome = Outcome(*_COUNTS.unpack_from(counts), elapsed_s)
        log = (folder / "log").read_text(errors="replace")
        if status > 0:
            raise RuntimeError(f"fuzzing {target.name} failed: {log}")
        if status < 0:
            finding = read_case(folder / "input")
            finding.kind = f"ended by {signal.Signals(-status).name}"
            finding.message = log[-1500:]
            outcome.findings[finding.kind] = finding
        for path in sorted(folder.glob("*.json")):
            finding = read_case(path)
            outcome.findings[finding.kind] = finding
        return outcome, status < 0


def _work(target: Target, seed: str, seconds: float, counts: mmap.mmap, folder: Path) -> None:
    _prepare(folder)
    started = time.process_time()
    number = 0

    def before(parts: Parts) -> None:
        nonlocal number
        number += 1
        _COUNTS.pack_into(counts, 0, number, 0, time.process_time() - started, 0)
        write_case(folder / "input", Finding(target.name, "", "", parts))

    outcome = fuzz(target, seed, seconds, before=before)
    _COUNTS.pack_into(
        counts, 0, outcome.executions, outcome.refused, outcome.seconds, outcome.corpus
    )
    for finding in outcome.findings.values():
        write_case(folder / case_name(finding), finding)


def _prepare(folder: Path) -> None:
    """Little memory, one thread, silence; a crash leaves its stack in the log."""
    limit_threads(1)
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(log, 2)
    faulthandler.enable(2)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _watched(process: int, counts: mmap.mmap) -> tuple[int, float]:
    """Exit status of a process, negative for a signal, and the time that passed [s].

    It is killed when an input takes too long. A poll that took long tells of a machine that stood
    still, whose time does not count.
    """
    silence, last, elapsed_s = 0.0, -1, 0.0
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), elapsed_s
        started = time.monotonic()
        time.sleep(POLL_S)
        elapsed_s += min(time.monotonic() - started, LONGEST_POLL_S)
        number = _COUNTS.unpack_from(counts)[0]
        silence = silence + POLL_S if number == last else 0.0
        last = number
        if silence > SILENCE_S:
            os.kill(process, signal.SIGKILL)
