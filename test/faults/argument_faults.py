"""Faults of what a user hands over: settings, numbers, poses, points, odometry from elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from faults import material
from faults.bench import Bench
from faults.expectations import LOST, ended, refused, run, seen_of, tracked
from faults.fault import Group, Seen, faults_of
from faults.material import FRAMES

Lines = list[str]


def each_refused(*lines: Sequence[object]) -> Callable[[Bench], Seen]:
    """Several command lines, every one of them nonsense; `MAP` and `WALK` stand for real ones."""

    def inject(bench: Bench) -> Seen:
        stands_for = {"MAP": material.stored_map(bench), "WALK": material.bag(bench)}
        done = []
        for line in lines:
            words = [stands_for.get(str(word), word) for word in line]
            done.append(bench.meslam(*words))
        told = seen_of(bench, done[-1]).words
        return Seen(f"{len(done)} refused, the last one: {told}", {"ended": tuple(done)})

    return inject


def _settings(*settings: str) -> Callable[[Bench], Seen]:
    return each_refused(*(("run", "WALK", "--out", "out", "--set", each) for each in settings))


def _odometry(change: Callable[[Lines], Lines | None], *options: object) -> Callable[[Bench], Seen]:
    """The walk with its true poses, or what becomes of them, as odometry."""

    def inject(bench: Bench) -> Seen:
        lines = material.truth(bench).read_text().splitlines()[1:]
        lines = change(lines) or lines
        file = bench.folder / "odometry.txt"
        file.write_text("\n".join(lines) + "\n")
        return run(bench, material.bag(bench), "--odometry", file, *options)

    return inject


def _shifted(line: str, stamp_s: float = 0.0, x_m: float = 0.0) -> str:
    stamp, x, *rest = line.split()
    return " ".join((f"{float(stamp) + stamp_s:.9f}", f"{float(x) + x_m:.9f}", *rest))


def _without_half(lines: Lines) -> Lines:
    return lines[:8] + lines[16:]


def _teleporting(lines: Lines) -> Lines:
    middle = len(lines) // 2
    return lines[:middle] + [_shifted(line, x_m=10.0) for line in lines[middle:]]


def _standing_still(lines: Lines) -> Lines:
    first = lines[0].split(maxsplit=1)[1]
    return [f"{line.split(maxsplit=1)[0]} {first}" for line in lines]


def _nan(lines: Lines) -> None:
    lines[7] = lines[7].replace(lines[7].split()[2], "nan")


def _continued(start_pose: str) -> Callable[[Bench], Seen]:
    """Go on with the walk's map from a pose that is not where the camera is."""

    def inject(bench: Bench) -> Seen:
        stored = bench.copy(material.stored_map(bench), "earlier.meslam")
        before = (stored / "manifest.json").read_bytes()
        seen = run(bench, material.bag(bench), "--map", stored, "--start-pose", start_pose)
        untouched = (stored / "manifest.json").read_bytes() == before
        return Seen(seen.words, {**seen.facts, "untouched": untouched})

    return inject


def _doubted(seen: Seen) -> str:
    """A warning tells that the map does not confirm the pose, and the map is as it was."""
    if not seen.facts["untouched"]:
        return "the stored map was changed"
    return ended("the stored map does not confirm")(seen)


def _noticed(seen: Seen) -> str:
    """Nothing is far off, or the run ends as lost before anything is."""
    (told,) = seen.facts["ended"]
    if told.unexplained:
        return str(told.unexplained)
    off_m = seen.facts["report"].get("ate_online_rmse_m") or 0.0
    limit_m = 0.20 if told.status == LOST else 0.05
    return "" if off_m < limit_m else f"{100 * off_m:.1f} cm off, and reported as good"


def _asked(points: Callable[[Path], object]) -> Callable[[Bench], Seen]:
    """Ask the walk's map about points in a file."""

    def inject(bench: Bench) -> Seen:
        file, out = bench.folder / "points.npy", bench.folder / "answers.npy"
        points(file)
        done = bench.meslam("query", material.stored_map(bench), "--points", file, "--out", out)
        answers = np.load(out, allow_pickle=False) if out.exists() else None
        seen = seen_of(bench, done)
        return Seen(seen.words, {**seen.facts, "report": answers is not None, "answers": answers})

    return inject


def _all_unknown(seen: Seen) -> str:
    if told := ended()(seen):
        return told
    known = int(np.count_nonzero(seen.facts["answers"]["occupancy"] != -1))
    return f"{known} points where nothing is are known" if known else ""


def _saved(points: object) -> Callable[[Path], None]:
    return lambda file: np.save(file, np.asarray(points))


def _cut(file: Path) -> None:
    np.save(file, np.zeros((1000, 3)))
    file.write_bytes(file.read_bytes()[:2000])


def _several(bench: Bench, arrays: Sequence[object]) -> Seen:
    done, words = [], ""
    for points in arrays:
        seen = _asked(_saved(points))(bench)
        if seen.facts["report"]:
            return seen
        done += seen.facts["ended"]
        words = seen.words
    return Seen(f"{len(done)} refused, the last one: {words}", {"ended": tuple(done)})


_fault = faults_of(Group.INPUT)


ARGUMENTS = (
    _fault(
        "settings-nonsense",
        "nine settings that do not exist, are of another type, out of range, NaN or infinite",
        "each is refused with status 2; nothing is written",
        _settings(
            "moon.phase=1",
            "mapping.iterations",
            "mapping.iterations=many",
            "mapping.iterations=-3",
            "mapping.iterations=1e99",
            "sensor.max_depth_m=nan",
            "sensor.max_depth_m=inf",
            "sensor.min_depth_m=4.5 ; rm -rf",
            "=",
        ),
        refused(),
    ),
    _fault(
        "settings-that-contradict",
        "a least depth beyond the largest depth",
        "refused with status 2; both settings are named",
        each_refused(
            (
                "run",
                "WALK",
                "--out",
                "out",
                "--set",
                "sensor.min_depth_m=4",
                "--set",
                "sensor.max_depth_m=1",
            ),
        ),
        refused("min_depth_m", "max_depth_m"),
    ),
    _fault(
        "arguments-nonsense",
        "ten command lines with frames, presets, seeds, poses and spacings without sense",
        "each is refused with status 2 and a message",
        each_refused(
            ("run", "WALK", "--out", "out", "--frames", "9:3"),
            ("run", "WALK", "--out", "out", "--frames", "a:b"),
            ("run", "WALK", "--out", "out", "--frames", "900:990"),
            ("run", "WALK", "--out", "out", "--preset", "best"),
            ("run", "WALK", "--out", "out", "--seed", "-1"),
            ("run", "WALK", "--out", "out", "--map", "MAP"),
            ("run", "WALK", "--out", "out", "--map", "MAP", "--start-pose", "0 0 0 0 0 0 0"),
            ("mesh", "MAP", "--out", "room.ply", "--resolution", "nan"),
            ("mesh", "MAP", "--out", "room.exe"),
            ("simulate", "room", "--out", "room.mcap", "--duration", "nan"),
        ),
        refused(),
    ),
    _fault(
        "truth-nonsense",
        "true poses that are no text, or five numbers a line",
        "refused before the first frame, with the line",
        each_refused(
            ("run", "WALK", "--out", "out", "--truth", "WALK"),
            ("evaluate", "WALK", "WALK"),
        ),
        refused("cannot be read"),
    ),
)
ODOMETRY = (
    _fault(
        "odometry-nan",
        "a pose of the given odometry is NaN",
        "refused before the first frame, with the line",
        _odometry(_nan),
        refused("odometry.txt, line 8", "not finite"),
    ),
    _fault(
        "odometry-unsorted",
        "the given odometry goes backwards in time",
        "refused before the first frame; the file is named",
        _odometry(lambda lines: lines[::-1]),
        refused("odometry.txt"),
    ),
    _fault(
        "odometry-gap",
        "the given odometry is silent for half a second",
        "the map alone tracks meanwhile; no frame is lost",
        _odometry(_without_half),
        tracked(FRAMES),
    ),
    _fault(
        "odometry-teleports",
        "the given odometry jumps by ten metres",
        "the jump is told and left out; no pose is off by more than 5 cm",
        _odometry(_teleporting),
        _noticed,
    ),
    _fault(
        "odometry-stands-still",
        "the given odometry says that the camera never moves",
        "the map contradicts it: DEGRADED, then LOST with status 3, before a pose is off by 20 cm",
        _odometry(_standing_still),
        _noticed,
    ),
    _fault(
        "odometry-of-another-day",
        "the given odometry's stamps are a day later",
        "the map alone tracks; no pose is off by more than 5 cm",
        _odometry(lambda lines: [_shifted(line, stamp_s=86_400.0) for line in lines]),
        _noticed,
    ),
)
START = (
    _fault(
        "start-pose-in-the-void",
        "a map is gone on with from a pose fifty metres outside of it",
        "a warning says that the map does not confirm it; the stored map is not changed",
        _continued("50 0 0 -0.5 0.5 -0.5 0.5"),
        _doubted,
    ),
    _fault(
        "start-pose-turned-round",
        "a map is gone on with looking backwards",
        "a warning says that the map does not confirm it; the stored map is not changed",
        _continued("0 0 0 0.5 0.5 -0.5 -0.5"),
        _doubted,
    ),
)
POINTS = (
    _fault(
        "query-nonsense",
        "points that are NaN, infinite, of two coordinates, texts, or a scalar",
        "refused; the message says what is expected",
        lambda bench: _several(
            bench, (np.full((2, 3), np.nan), [[np.inf, 0, 0]], [[1.0, 2.0]], [["a", "b", "c"]], 3.0)
        ),
        refused("(N, 3)"),
    ),
    _fault(
        "query-far-away",
        "points at 1e300 m and at the largest integers",
        "they are unknown",
        _asked(_saved([[1e300, -1e300, 0.0], [9e15, 0.0, 9e15], [0.0, 1e9, 0.0]])),
        _all_unknown,
    ),
    _fault(
        "query-truncated",
        "a file of points that is cut off",
        "refused; the file is named",
        _asked(_cut),
        refused("points.npy"),
    ),
)


FAULTS = ARGUMENTS + ODOMETRY + START + POINTS
