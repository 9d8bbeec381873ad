"""The harness notices what it is made for, every entry is well-formed, and the quick ones hold."""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path

import pytest
import typer
from faults import catalogue, table
from faults.__main__ import main
from faults.bench import wait_for
from faults.catalogue import every_fault
from faults.fault import Fault, Group, Seen
from faults.injection import Result, Verdict
from faults.runner import Trial
from faults.spoilt_harness import FAULTS
from typer.testing import CliRunner

SPOILT = {fault.name: fault for fault in FAULTS}
QUICK = [fault for fault in every_fault() if fault.quick]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults") / "cache"


@pytest.mark.parametrize(
    ("name", "verdict", "words"),
    [
        ("hang", Verdict.MISSED, "hang"),
        ("crash", Verdict.MISSED, "unexplained exit: SIGSEGV"),
        ("exit", Verdict.MISSED, "unexplained exit: exit status 5"),
        ("raise", Verdict.MISSED, "unexplained error: KeyError: 'depth'"),
        ("lost-map", Verdict.MISSED, "lost map"),
        ("harmed-map", Verdict.AS_EXPECTED, ""),
        ("miss", Verdict.MISSED, "a cat instead of a dog"),
        ("skip", Verdict.SKIPPED, ""),
        ("fine", Verdict.AS_EXPECTED, ""),
    ],
)
def test_the_harness_notices(name: str, verdict: Verdict, words: str, tmp_path: Path) -> None:
    result = Trial(SPOILT[name], tmp_path / name, tmp_path, "faults.spoilt_harness").wait()
    assert result.verdict == verdict, (tmp_path / name / "output.txt").read_text()
    assert words in result.problem
    assert bool(result.problem) == (verdict == Verdict.MISSED)
    wait_for(lambda: not _processes_in(tmp_path), "the end of all that a fault started")


def test_a_run_goes_on_where_it_was_and_fails_on_a_miss(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalogue, "modules", lambda: ["faults.spoilt_harness"])

    def run(*names: str) -> int:
        app = typer.Typer()
        app.command()(main)
        return CliRunner().invoke(app, [*names, "--out", str(tmp_path)]).exit_code

    assert run("fine", "skip") == 0
    (first,) = tmp_path.glob("*/fine/result.json")
    before = first.stat().st_mtime_ns
    assert run("fine", "miss") == 1
    assert first.stat().st_mtime_ns == before
    page = (tmp_path / "reliability.md").read_text()
    assert "2 faults: 1 as expected, 1 missed." in page
    assert run("fine", "--fresh") == 0
    assert first.stat().st_mtime_ns != before
    assert run("moon") == 2


def test_every_fault_is_well_formed() -> None:
    faults = every_fault()
    assert len(faults) >= 60
    assert len(faults) == len({fault.name for fault in faults})
    groups = Counter(fault.group for fault in faults)
    assert set(groups) <= set(Group)
    # A fault that the page does not tell of is a fault that nobody knows.
    assert set(table.TITLES) == set(Group)


@pytest.mark.parametrize("name", ["Depth", "depth zero", "depth_zero", ""])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(ValueError, match="no name"):
        Fault(name, Group.INPUT, "a", "b", lambda bench: Seen(""), lambda seen: "")


@pytest.mark.parametrize("fault", QUICK, ids=lambda fault: fault.name)
def test_quick_faults(fault: Fault, tmp_path: Path, cache: Path) -> None:
    result = Trial(fault, tmp_path / fault.name, cache).wait()
    if result.verdict == Verdict.SKIPPED:
        pytest.skip(result.seen)
    assert result.verdict == Verdict.AS_EXPECTED, f"{result.seen}; {result.problem}"


def test_the_page_tells_everything(tmp_path: Path) -> None:
    faults = [SPOILT["fine"], SPOILT["miss"]]
    results = {
        "fine": Result("fine", Verdict.AS_EXPECTED, "a | b", "", 1.0),
        "miss": Result("miss", Verdict.MISSED, "a cat", "instead of a dog", 2.0),
    }
    table.write(tmp_path / "page.md", faults, results, 90.0)
    page = (tmp_path / "page.md").read_text()
    assert "2 faults: 1 as expected, 1 missed, in 1.5 minutes" in page
    assert (
        "| `miss` | miss is injected | nothing | a cat; instead of a dog | 2.0 | missed |" in page
    )
    assert "a \\| b" in page
    entries = json.loads((tmp_path / "page.json").read_text())["faults"]
    assert [entry["verdict"] for entry in entries] == ["as expected", "missed"]


def _processes_in(folder: Path) -> list[Path]:
    return [p for p in Path("/proc").glob("[0-9]*/cwd") if _target(p).startswith(str(folder))]


def _target(link: Path) -> str:
    try:
        return os.readlink(link)
    except OSError:
        return ""
