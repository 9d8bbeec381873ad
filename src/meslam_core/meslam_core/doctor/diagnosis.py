"""The whole examination: the core's own, and those that other packages add."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from meslam_core.doctor.devices import examine_devices
from meslam_core.doctor.finding import Examination, Finding, Status, fail, warn
from meslam_core.doctor.packages import examine_packages
from meslam_core.doctor.processor import examine_processor
from meslam_core.doctor.storage import examine_storage

ENTRY_POINTS = "meslam.doctor"
"""Group of entry points; each names an `Examination`, its name is the area."""

NO_ROS = (
    "for the nodes: `source env.bash` in the folder of MeSLAM (after `make setup`); "
    "recordings are mapped without"
)


@dataclass(frozen=True)
class Area:
    """Findings that belong together.

    Attributes:
        name: of the area.
        findings: in it.
    """

    name: str
    findings: tuple[Finding, ...]


def examinations(folder: Path) -> dict[str, Examination]:
    """Everything that can be looked at, by area.

    Args:
        folder: where results are to go.
    """
    return {
        "Python": examine_packages,
        "computing": examine_processor,
        "storage": partial(examine_storage, folder),
        "devices": examine_devices,
        **_added(metadata.entry_points(group=ENTRY_POINTS)),
    }


def _added(points: Iterable[metadata.EntryPoint]) -> dict[str, Examination]:
    """What other packages look at; that of ROS is missed where it is not there."""
    found: dict[str, Examination] = {point.name: partial(_loaded, point) for point in points}
    return found or {"ROS": lambda: [warn("meslam_ros", "is not on the path", NO_ROS)]}


def _loaded(point: metadata.EntryPoint) -> Iterable[Finding]:
    examine: Examination = point.load()
    return examine()


def diagnose(
    wanted: dict[str, Examination], started: Callable[[str], None] = lambda area: None
) -> Iterator[Area]:
    """Look at one area after the other; an examination that breaks is a finding itself.

    Args:
        wanted: by area.
        started: told the area that is looked at next.
    """
    for name, examine in wanted.items():
        started(name)
        findings: list[Finding] = []
        try:
            findings.extend(examine())
        # Whatever is broken here is what the doctor was called for.
        except Exception as error:
            told = f"cannot be examined: {type(error).__name__}: {error}"
            remedy = "run `make setup` in the folder of MeSLAM; if that does not help, report this"
            findings.append(fail(name, told, remedy))
        yield Area(name, tuple(findings))


def gravest(areas: Iterable[Area]) -> Status:
    """The worst of all findings."""
    found = {finding.status for area in areas for finding in area.findings}
    return next((each for each in (Status.FAIL, Status.WARN) if each in found), Status.OK)
