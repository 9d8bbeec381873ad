"""Kill whole runs at random instants: python test/faults/sigkill.py --trials 200

Every trial is a run of the `meslam` command into the same folder, with another seed and so another
map, that is killed (SIGKILL) at a uniformly random instant of the time it takes. What must hold
afterwards: the map that was there before, or the one of this run, loads whole; and the next run can
begin in the folder at once. A second series kills between the writing of the map and the end.
The table is kept in docs/reliability/sigkill.json; what is in it is not done again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "test"))

from data.bag_builder import aligned_bag  # noqa: E402
from data.textured_room import frame_at, path  # noqa: E402

# A run that is forked need not import them again.
from meslam_core import console, continuation, pipeline, recordings  # noqa: E402, F401
from meslam_core.cli import app  # noqa: E402
from meslam_core.errors import MeslamError  # noqa: E402
from meslam_core.map.store import MapStore  # noqa: E402
from meslam_core.results import MAP, REPORT, STAGING, ResultFolder  # noqa: E402

RECORD = ROOT / "docs/reliability/sigkill.json"
FRAMES = 20
WHOLE_RUNS = 3
SETTINGS = (
    "regions.volume_m3=3",
    "keyframes.rays=1024",
    "mapping.first_iterations=60",
    "mapping.iterations=4",
    "mapping.keyframe_iterations=8",
    "mapping.final_iterations=10",
)
"""A short run whose map has several regions."""
POLL_S = 0.0005
RESULTS_S = 0.3
"""Processor time from the writing of the map to the end, at most."""


@dataclass(frozen=True)
class Kill:
    """One trial.

    Attributes:
        series: "whole run", or "results" for the time from the writing of the map to the end.
        number: of the trial in its series; also the seed.
        instant: share of the run's processor time at which it was killed; from the writing on,
            processor seconds since then.
        stage: what the run was doing, as its folder shows it.
        map: which map was there: the one from "before", the "new" one, or why there was none.
        regions: of that map.
        next_run: whether the next run could begin; else why not.
    """

    series: str
    number: int
    instant: float
    stage: str
    map: str
    regions: int
    next_run: str

    @property
    def held(self) -> bool:
        """Whether nothing was lost."""
        return self.map in ("before", "new") and self.regions > 0 and self.next_run == "begins"


class Runs:
    """Runs of one recording into one folder, each a process of its own.

    Args:
        folder: for the recording and the results.
    """

    def __init__(self, folder: Path) -> None:
        frames = [frame_at(pose, n) for n, pose in enumerate(path(FRAMES, 0.03, 1.5))]
        self._recording = aligned_bag(frames, folder)
        self._log = folder / "log"
        self.out = folder / "out"

    @contextlib.contextmanager
    def started(self, seed: int) -> Iterator[int]:
        """A run; it is killed at the latest on leaving."""
        arguments = ["run", str(self._recording), "--out", str(self.out), "--seed", str(seed)]
        for setting in SETTINGS:
            arguments += ["--set", setting]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads
            process = os.fork()
        if process == 0:
            _run_command(arguments, self._log)
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)

    def whole(self, seed: int) -> float:
        """A run to its end; the processor time it took [s]."""
        with self.started(seed) as process:
            used_s = 0.0
            while os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                used_s = processor_s(process)
                time.sleep(POLL_S)
            status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        if status != 0:
            log = self._log.read_text()[-2000:]
            raise RuntimeError(f"a run that nobody kills ends with status {status}: {log}")
        return used_s

    def killed(self, seed: int, instant_s: float, after_writing: bool = False) -> bool:
        """A run that is killed when it used so much processor time [s]; false where it ended first.

        Args:
            seed: of the run.
            instant_s: processor time, from the start or from the writing of the map on [s].
            after_writing: which of both.
        """
        began_s = None if after_writing else 0.0
        with self.started(seed) as process:
            while os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                used_s = processor_s(process)
                if began_s is None and any(self.out.glob(f"{STAGING}.*/{MAP}")):
                    began_s = used_s
                if began_s is not None and used_s - began_s >= instant_s:
                    return True
                time.sleep(POLL_S)
        return False

    def stage(self) -> str:
        """What a killed run was doing."""
        if any(self.out.glob(f"{STAGING}.*/{MAP}/manifest.json")):
            return "putting results in place"
        if any(self.out.glob(f"{STAGING}.*/{MAP}")):
            return "writing the map"
        return "tracking" if any(self.out.glob(f"{STAGING}.*")) else "starting or ending"


def processor_s(process: int) -> float:
    """Processor time that a process used with all its threads [s] (clock_getcpuclockid(3))."""
    try:
        return time.clock_gettime(~process << 3 | 2)
    except OSError:
        return float("inf")


def trial(runs: Runs, series: str, number: int, duration_s: float) -> Kill:
    """Kill a run and look at what it left."""
    generator = Random(f"{series} {number}")
    before = MapStore(runs.out / MAP).load().map_id
    after_writing = series == "results"
    instant = generator.uniform(0.0, RESULTS_S if after_writing else 1.0)
    in_time = runs.killed(number + 1, instant * (1 if after_writing else duration_s), after_writing)
    stage = runs.stage() if in_time else "ended"
    try:
        loaded = MapStore(runs.out / MAP).load()
        found = "before" if loaded.map_id == before else "new"
        regions = len(loaded.regions)
        if loaded.warnings:
            found = loaded.warnings[0]
    except MeslamError as error:
        found, regions = str(error), 0
    try:
        with ResultFolder(runs.out):
            next_run = "begins"
    except MeslamError as error:
        next_run = str(error)
    return Kill(series, number, round(instant, 4), stage, found, regions, next_run)


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the trials; exit status 1 when anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=200, help="over whole runs")
    parser.add_argument("--results", type=int, default=80, help="while results are written")
    parser.add_argument("--record", type=Path, default=RECORD, help="where the table is kept")
    given = parser.parse_args(arguments)
    kills = _read(given.record)
    done = {(kill.series, kill.number) for kill in kills}
    wanted = [("whole run", number) for number in range(given.trials)]
    wanted += [("results", number) for number in range(given.results)]
    with tempfile.TemporaryDirectory(prefix="sigkill-") as folder:
        runs = Runs(Path(folder))
        duration_s = statistics.median(runs.whole(seed) for seed in range(WHOLE_RUNS))
        print(f"a run takes {duration_s:.2f} s of processor time", flush=True)
        for series, number in wanted:
            if (series, number) in done:
                continue
            kill = trial(runs, series, number, duration_s)
            kills.append(kill)
            _write(given.record, kills, duration_s)
            print(
                f"{series} {number}: {kill.instant:.3f}, {kill.stage}, {kill.map} map", flush=True
            )
        runs.whole(0)
        report = json.loads((runs.out / REPORT).read_text())
        print(f"a last run to its end: {report['frames_tracked']} frames tracked")
    lost = [kill for kill in kills if not kill.held]
    for kill in lost:
        print(f"LOST: {kill}")
    print(f"{len(kills) - len(lost)} of {len(kills)} maps load after SIGKILL")
    return 1 if lost else 0


def _run_command(arguments: list[str], log: Path) -> None:
    """The `meslam` command in this process, which then ends."""
    for descriptor in (1, 2):
        os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), descriptor)
    status = 1
    try:
        app(arguments)
    except SystemExit as end:
        status = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _read(record: Path) -> list[Kill]:
    if not record.exists():
        return []
    return [Kill(**entry) for entry in json.loads(record.read_text())["kills"]]


def _write(record: Path, kills: list[Kill], duration_s: float) -> None:
    record.parent.mkdir(parents=True, exist_ok=True)
    stages = Counter(f"{kill.series}: {kill.stage}, {kill.map} map" for kill in kills)
    document = {
        "kills_survived": sum(kill.held for kill in kills),
        "kills_total": len(kills),
        "run_processor_s": round(duration_s, 2),
        "stages": dict(sorted(stages.items())),
    }
    lines = ",\n  ".join(json.dumps(asdict(kill)) for kill in kills)
    text = json.dumps(document, indent=1).removesuffix("\n}")
    record.write_text(f'{text},\n "kills": [\n  {lines}\n ]\n}}\n')


if __name__ == "__main__":
    sys.exit(main())
