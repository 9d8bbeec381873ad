"""Too little of what a process needs: time, room for its words, file handles."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable

from faults import material
from faults.bench import MESLAM, Bench, Ended
from faults.earlier_run import started
from faults.expectations import ended, run, seen_of, tracked
from faults.fault import Group, Seen, faults_of
from faults.material import FRAMES

CYCLE_S = 0.1


def _suspended(bench: Bench) -> Seen:
    out = bench.folder / "results"

    def suspend(process: subprocess.Popen[str]) -> None:
        started(out, process)
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.send_signal(signal.SIGCONT)

    return run(bench, material.bag(bench), "--realtime", during=suspend)


def _quarter(bench: Bench) -> Seen:
    """A quarter of every tenth of a second is the run's."""
    out = bench.folder / "results"

    def slow(process: subprocess.Popen[str]) -> None:
        started(out, process)
        while process.poll() is None:
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.75 * CYCLE_S)
            process.send_signal(signal.SIGCONT)
            time.sleep(0.25 * CYCLE_S)

    return run(bench, material.bag(bench), "--realtime", during=slow)


def _some_skipped(seen: Seen) -> str:
    """Frames are left out and counted, all others are tracked, none of them far off."""
    (told,) = seen.facts["ended"]
    report = seen.facts["report"]
    if told.unexplained or not report:
        return str(told.unexplained or told.message)
    if report["frames"] + report["frames_skipped"] != FRAMES:
        return f"{report['frames']} processed and {report['frames_skipped']} skipped"
    if report["frames_tracked"] < report["frames"]:
        return f"{report['frames_lost']} of {report['frames']} frames lost"
    # Of one or two frames there is no trajectory to compare.
    off_m = report.get("ate_online_rmse_m") or 0.0
    return "" if off_m < 0.05 else f"{100 * off_m:.1f} cm off, and reported as good"


def _few_handles(bench: Bench) -> Seen:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (24, 24))

    return run(bench, material.bag(bench), before=limit)


def _to(place: str, *arguments: object) -> Callable[[Bench], Seen]:
    """The command's results go to a device."""

    def inject(bench: Bench) -> Seen:
        with open(place, "w", encoding="utf-8") as output:
            process = subprocess.run(
                [*MESLAM, *map(str, arguments), str(material.bag(bench))],
                cwd=bench.folder,
                stdout=output,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        return seen_of(bench, Ended(process.returncode, "", process.stderr))

    return inject


def _without(*descriptors: int) -> Callable[[Bench], Seen]:
    """Standard streams are closed, as some service managers do."""

    def close() -> None:
        for descriptor in descriptors:
            os.close(descriptor)

    return lambda bench: run(bench, material.bag(bench), "--frames", "0:8", before=close)


def _reader_gone(bench: Bench) -> Seen:
    """`meslam info WALK | true`."""
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.run(
        [*MESLAM, "info", str(material.bag(bench))],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writing)
    return seen_of(bench, Ended(process.returncode, "", process.stderr))


def _no_traceback(seen: Seen) -> str:
    (told,) = seen.facts["ended"]
    if told.status < 0 or "Traceback" in told.stderr or "Exception ignored" in told.stderr:
        return str(told.unexplained or told.stderr.strip().splitlines()[-1])
    return ""


def _bare(bench: Bench) -> Seen:
    surroundings = {"HOME": "/nowhere", "LANG": "C", "LC_ALL": "C", "TERM": "", "COLUMNS": "1"}
    recording = bench.copy(material.bag(bench), "wälk.mcap")
    return run(bench, recording, "--frames", "0:8", environment=surroundings)


def _without_temporary(bench: Bench) -> Seen:
    missing = bench.folder / "gone"
    return run(bench, material.bag(bench), environment={"TMPDIR": str(missing)})


def _eight_done(seen: Seen) -> str:
    (told,) = seen.facts["ended"]
    if told.status != 0:
        return told.unexplained or f"exit status {told.status}"
    return "" if seen.facts["report"].get("frames_tracked") == 8 else "not eight frames tracked"


_fault = faults_of(Group.LOAD)


FAULTS = (
    _fault(
        "suspended",
        "the process is stopped for two seconds of a run at the recording's pace",
        "frames are skipped and counted; the others are tracked",
        _suspended,
        _some_skipped,
    ),
    _fault(
        "quarter-of-a-core",
        "a run at the recording's pace gets a quarter of its computing time",
        "frames are skipped and counted; the others are tracked",
        _quarter,
        _some_skipped,
    ),
    _fault(
        "few-file-handles",
        "a process may have 24 files open",
        "it runs, or says what it could not open",
        _few_handles,
        lambda seen: str(seen.facts["ended"][0].unexplained),
    ),
    _fault(
        "output-to-a-full-disk",
        "what the command prints goes to a full disk",
        "status 2; the message says so",
        _to("/dev/full", "info"),
        ended("No space left", status=2),
    ),
    _fault(
        "reader-gone",
        "the program that reads what the command prints has ended",
        "it ends without a traceback",
        _reader_gone,
        _no_traceback,
    ),
    _fault(
        "error-stream-closed",
        "standard error is closed during a run",
        "the run goes on; the results are there",
        _without(2),
        _eight_done,
    ),
    _fault(
        "all-streams-closed",
        "standard input, output and error are closed during a run",
        "the run goes on; the results are there",
        _without(0, 1, 2),
        _eight_done,
    ),
    _fault(
        "bare-surroundings",
        "no home, the C locale, no terminal, one column, and a name with an umlaut",
        "the run goes on; the results are there",
        _bare,
        _eight_done,
    ),
    _fault(
        "no-temporary-folder",
        "the folder for temporary files does not exist",
        "another one is taken; every frame is tracked",
        _without_temporary,
        tracked(FRAMES),
    ),
)
