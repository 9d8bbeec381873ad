"""Where runs come from: command, recording, machine and versions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from meslam_core.report.run_folder import RunFolder

Entries = Mapping[str, Any]


def origin_lines(runs: Sequence[RunFolder]) -> list[tuple[str, list[str]]]:
    """Labels, and a text a run, of what any of the runs tells."""
    lines = [(label, [_told(tell, run.entries) for run in runs]) for label, tell in _LINES]
    folders = ("results", [str(run.path.resolve()) for run in runs])
    return [folders, *(line for line in lines if any(line[1]))]


def _told(tell: Callable[[Entries], Any], entries: Entries) -> str:
    value = tell(entries)
    return "" if value is None else str(value)


def _machine(entries: Entries) -> str:
    machine = _mapping(entries, "machine")
    parts = [str(machine[key]) for key in ("processor", "gpu") if machine.get(key)]
    if machine.get("cores"):
        parts.append(f"{machine['cores']} cores")
    if isinstance(machine.get("memory_gb"), int | float):
        parts.append(f"{machine['memory_gb']:.1f} GB of memory")
    return ", ".join(parts)


def _frames(entries: Entries) -> str:
    chosen = entries.get("frame_range")
    if not isinstance(chosen, list) or len(chosen) != 3:
        return ""
    start, stop, step = ("" if part is None else str(part) for part in chosen)
    return "all" if (start, stop, step) == ("0", "", "1") else f"{start}:{stop}:{step}"


def _pace(entries: Entries) -> str | None:
    realtime = entries.get("realtime")
    if realtime is None:
        return None
    return "at the recording's pace" if realtime else "every frame, as fast as it went"


def _versions(entries: Entries) -> str:
    versions = _mapping(entries, "versions")
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def _camera(entries: Entries) -> str:
    camera = _mapping(entries, "camera")
    if not {"width", "height", "fx", "fy"} <= camera.keys():
        return ""
    return f"{camera['width']}x{camera['height']}, fx {camera['fx']}, fy {camera['fy']}"


def _mapping(entries: Entries, key: str) -> Mapping[str, Any]:
    value = entries.get(key)
    return value if isinstance(value, Mapping) else {}


_LINES: tuple[tuple[str, Callable[[Entries], Any]], ...] = (
    ("command", lambda entries: entries.get("command")),
    ("recording", lambda entries: entries.get("recording_path") or entries.get("recording")),
    ("frames", _frames),
    ("true poses", lambda entries: entries.get("truth")),
    ("camera", _camera),
    ("pace", _pace),
    ("seed", lambda entries: entries.get("seed")),
    ("finished", lambda entries: entries.get("finished")),
    ("broke off", lambda entries: entries.get("broke_off")),
    ("machine", _machine),
    ("system", lambda entries: _mapping(entries, "machine").get("system")),
    ("versions", _versions),
)
