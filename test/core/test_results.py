"""The folder of a run's results: complete, or untouched."""

from __future__ import annotations

import json
import os
import shutil

import pytest

from meslam_core.errors import OutputError
from meslam_core.results import REPORT, TRAJECTORY, ResultFolder


def fill(results: ResultFolder, text: str) -> None:
    results.incomplete(TRAJECTORY).write_text(text)
    results.write_report({"text": text})


def test_results_appear_together_when_published(tmp_path):
    with ResultFolder(tmp_path / "a" / "b") as results:
        fill(results, "new")
        assert not (tmp_path / "a" / "b" / TRAJECTORY).exists()
        results.publish()
    folder = tmp_path / "a" / "b"
    assert sorted(file.name for file in folder.iterdir()) == [REPORT, TRAJECTORY]
    assert json.loads((folder / REPORT).read_text()) == {"text": "new"}


def test_nothing_is_left_when_the_work_fails(tmp_path):
    def work() -> None:
        with ResultFolder(tmp_path / "a" / "b") as results:
            fill(results, "half")
            raise RuntimeError("out of luck")

    with pytest.raises(RuntimeError, match="out of luck"):
        work()
    assert list(tmp_path.iterdir()) == []


def test_earlier_results_survive_a_failure_and_give_way_to_a_success(tmp_path):
    for text, succeeds in (("first", True), ("half", False), ("second", True)):
        with ResultFolder(tmp_path) as results:
            fill(results, text)
            if succeeds:
                results.publish()
        expected = text if succeeds else "first"
        assert (tmp_path / TRAJECTORY).read_text() == expected
    assert sorted(file.name for file in tmp_path.iterdir()) == [REPORT, TRAJECTORY]


def test_a_map_of_an_earlier_run_does_not_stay_beside_new_results(tmp_path):
    (tmp_path / "map.meslam").mkdir()
    (tmp_path / "map.meslam" / "manifest.json").write_text("{}")
    with ResultFolder(tmp_path) as results:
        fill(results, "no map this time")
        results.publish()
    assert not (tmp_path / "map.meslam").exists()
    assert (tmp_path / "previous.meslam" / "manifest.json").read_text() == "{}"


def test_a_folder_that_is_no_map_is_not_replaced(tmp_path):
    (tmp_path / "map.meslam").mkdir()
    (tmp_path / "map.meslam" / "thesis.tex").write_text("years of work")
    with (
        pytest.raises(OutputError, match=r"map\.meslam.*choose another folder"),
        ResultFolder(tmp_path),
    ):
        pass
    assert (tmp_path / "map.meslam" / "thesis.tex").exists()


def test_other_files_in_the_folder_are_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with ResultFolder(tmp_path) as results:
        fill(results, "new")
        results.publish()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_place_that_cannot_be_written_is_known_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("long" * 100)):
        with pytest.raises(OutputError, match="cannot be written"), ResultFolder(place):
            pass


def test_a_report_holds_no_number_that_json_lacks(tmp_path):
    with ResultFolder(tmp_path / "a") as results, pytest.raises(ValueError, match="JSON"):
        results.write_report({"fps": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_two_runs_do_not_share_a_folder(tmp_path):
    with ResultFolder(tmp_path) as results:
        fill(results, "mine")
        with (
            pytest.raises(OutputError, match=rf"being written by process {os.getpid()} \("),
            ResultFolder(tmp_path),
        ):
            pass
        results.publish()
    assert (tmp_path / TRAJECTORY).read_text() == "mine"
    with ResultFolder(tmp_path):
        pass


def test_a_folder_that_vanishes_meanwhile_is_made_again(tmp_path):
    with ResultFolder(tmp_path / "out") as results:
        shutil.rmtree(tmp_path / "out")
        fill(results, "in spite of all")
        results.publish()
    assert (tmp_path / "out" / TRAJECTORY).read_text() == "in spite of all"
    assert not list((tmp_path / "out").glob(".*"))
