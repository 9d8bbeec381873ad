"""The page about runs: whole, true, without anything from elsewhere, and plain about gaps."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from data.memory_recording import MemoryRecording
from data.run_folders import copied_run
from PIL import Image
from typer.testing import CliRunner

from meslam_core.cli import app
from meslam_core.errors import EvaluationError
from meslam_core.recordings import convert, open_recording
from meslam_core.report import read_run, write_report
from meslam_core.report.result_table import result_groups


class Page(HTMLParser):
    """What a page refers to, its names and its text."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.references: list[str] = []
        self.ids: list[str] = []
        self.images: dict[str, list[str]] = {}
        self.tags: set[str] = set()
        self.text = ""
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        for name in ("src", "href", "xlink:href", "srcset", "action", "data"):
            if name in given:
                self.references.append(given[name])
        if "id" in given:
            self.ids.append(given["id"])
        if tag == "img":
            self.images.setdefault(given["alt"], []).append(given["src"])

    def handle_data(self, data: str) -> None:
        self.text += data


def made(*folders: Path, views: int = 0) -> Page:
    """The page about runs."""
    runs = [read_run(folder) for folder in folders]
    target = folders[0].parent / "page.html"
    write_report(runs, target, views)
    for run in runs:
        run.close()
    return Page(target)


def pixels(data_uri: str) -> np.ndarray:
    """RGB of an image in the page."""
    data = base64.b64decode(data_uri.partition(";base64,")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float64)


def section(page: Page, name: str) -> str:
    match = re.search(rf'<section id="{name}">.*?</section>', page.source, re.DOTALL)
    assert match, f"the page has no section {name}"
    return match.group()


@pytest.fixture(scope="module")
def page(tmp_path_factory, finished_run, walk) -> Page:
    """The page about the finished run; its map is rendered once for all tests."""
    folder = copied_run(
        finished_run.out, tmp_path_factory.mktemp("page") / "run", recording_path=str(walk)
    )
    return made(folder, views=2)


def test_the_page_needs_nothing_from_elsewhere(page):
    assert page.references
    assert all(reference.startswith(("data:", "#")) for reference in page.references)
    assert not page.tags & {"script", "iframe", "object", "embed", "base", "form"}
    assert "http" not in page.source.replace("http-equiv", "")
    assert "@import" not in page.source
    assert set(re.findall(r"url\((.)", page.source)) <= {"#"}
    assert len(page.source) < 2_000_000


def test_references_within_the_page_lead_somewhere(page):
    assert len(page.ids) == len(set(page.ids))
    inside = {reference[1:] for reference in page.references if reference.startswith("#")}
    inside |= set(re.findall(r"url\(#([^)]*)\)", page.source))
    assert inside <= set(page.ids)


def test_it_tells_what_the_run_reached(page, finished_run):
    report = finished_run.outcome.report
    results = section(page, "results")
    assert f"{100 * report['ate_rmse_m']:.2f}" in results
    assert f"{report['map_bytes'] / 1e3:.1f}" in results
    for name in ("path", "tracking", "time", "growth"):
        assert "<svg" in section(page, name)
    assert "Every frame was tracked with state OK" in page.text
    assert "cannot show" not in page.text


def test_the_map_is_shown_beside_the_camera(page, room_frames):
    names = ("camera image", "map from the same pose", "error of the rendered depth")
    camera, rendered, errors = (page.images[name] for name in names)
    assert len(camera) == len(rendered) == len(errors) == 2
    for image, view in zip(map(pixels, camera), map(pixels, rendered), strict=True):
        sharpest = min(np.abs(image - frame.color).mean() for frame in room_frames)
        assert sharpest < 6.0
        assert np.abs(image - view).mean() < 0.5 * np.abs(image - image.mean(axis=(0, 1))).mean()
    for error_mm in re.findall(r"median depth error ([\d.]+) mm", page.source):
        assert float(error_mm) < 20.0


def test_what_differs_from_the_default_is_marked(page):
    changed = section(page, "configuration").partition("<details>")[0]
    assert "mapping.first_iterations" in changed
    assert '<td class="n changed">150</td>' in changed
    assert "tracking.points" not in changed
    assert "tracking.points" in section(page, "configuration")


def test_several_runs_stand_side_by_side(make_run):
    first = make_run("first")
    config = json.loads((first / "report.json").read_text())["config"]
    config["mapping"]["first_iterations"] = 300
    page = made(first, make_run("second", config=config, peak_rss_mb=12.0), views=1)
    assert re.findall(r'<th class="n">(\w+)</th>', section(page, "results")) == ["first", "second"]
    assert '<td class="n best">12</td>' in section(page, "results")
    settings = section(page, "configuration")
    assert '<td class="n changed">150</td><td class="n">300</td>' in settings
    for name in ("path", "map", "time"):
        assert re.findall(r"</i>(first|second)</h3>", section(page, name)) == ["first", "second"]
    one, other = page.images["camera image"]
    assert one == other


def test_runs_of_different_recordings_are_not_ranked(make_run):
    first = read_run(make_run("first"))
    for recording, marks in (("memory", True), ("another", False)):
        second = read_run(make_run(recording, recording=recording, peak_rss_mb=12.0))
        lines = [line for group in result_groups([first, second]).values() for line in group]
        assert any(any(line.best) for line in lines) == marks


def test_what_a_run_has_not_is_said(make_run, tmp_path):
    folder = make_run(truth=str(tmp_path / "gone.txt"), recording_path=str(tmp_path / "gone.mcap"))
    (folder / "frames.csv").unlink()
    page = made(folder, views=1)
    note = page.text.partition("cannot show")[2].partition("Results")[0]
    for word in ("frames.csv", "gone.txt", "gone.mcap", "--truth", "--recording"):
        assert word in note
    assert "camera image" not in page.images
    assert len(page.images["map from the same pose"]) == 1
    assert 'id="tracking"' not in page.source
    assert "median" in section(page, "time")


def test_columns_that_were_not_recorded_are_named(make_run):
    folder = make_run()
    rows = list(csv.reader((folder / "frames.csv").open()))
    for row in rows[1:]:
        row[rows[0].index("odometry_ms")] = row[rows[0].index("rss_mb")] = ""
    with (folder / "frames.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    run = read_run(folder)
    run.close()
    (note,) = [sentence for sentence in run.missing if sentence.startswith("Over time")]
    assert "odometry" in note
    assert "memory" in note
    assert "tracking" not in note


def test_states_alone_are_shown(make_run):
    folder = make_run()
    (folder / "frames.csv").write_text("stamp_s,state\n1.0,OK\n2.0,LOST\n")
    page = made(folder)
    assert "<svg" in section(page, "tracking")
    assert 'id="growth"' not in page.source


def test_without_a_map_and_a_path_the_rest_is_shown(make_run):
    folder = make_run(frames_tracked=0, frames_lost=16)
    for name in ("trajectory.txt", "trajectory_online.txt", "map.meslam/manifest.json"):
        (folder / name).unlink()
    page = made(folder)
    note = page.text.partition("cannot show")[2].partition("Results")[0]
    assert "not enough frames got a pose" in note
    assert "Views of the map" in note
    assert "<svg" in section(page, "tracking")


def test_the_recording_is_read_as_the_run_read_it(make_run, room_frames, tmp_path):
    bag = tmp_path / "walk.mcap"
    convert(MemoryRecording(room_frames[:2]), bag)
    topics = open_recording(bag).topics
    for color, found in ((topics["color"], True), ("/camera/nowhere", False)):
        folder = make_run(f"run{found}", recording_path=str(bag), topics=topics | {"color": color})
        run = read_run(folder)
        run.close()
        assert (run.recording is not None) == found
        assert any("/camera/nowhere" in sentence for sentence in run.missing) != found


def test_a_damaged_region_is_named(make_run):
    folder = make_run()
    file = next((folder / "map.meslam").glob("region_*"))
    file.write_bytes(file.read_bytes()[:-100])
    run = read_run(folder)
    run.close()
    assert run.map is None
    assert any("region (0, 0, 0)" in sentence for sentence in run.missing)


def test_another_recording_is_noticed(make_run, tmp_path):
    folder = make_run()
    lines = (folder / "trajectory.txt").read_text().splitlines()
    moved = [re.sub(r"^(\d+)\.", lambda m: f"{int(m.group(1)) + 500}.", line) for line in lines]
    (folder / "trajectory.txt").write_text("\n".join(moved))
    assert "so it is another" in made(folder, views=1).text


def test_names_and_reasons_are_shown_as_text_and_told_apart(make_run, tmp_path):
    (tmp_path / "a").mkdir()
    folder = make_run("a/<b>bold $x$")
    table = (folder / "frames.csv").read_text().splitlines()
    table[5] = table[5].replace(",OK,,", ",LOST,<script>alert(1)</script>,")
    (folder / "frames.csv").write_text("\n".join(table) + "\n")
    page = made(folder, make_run("<b>bold $x$"))
    assert "a/<b>bold $x$" in page.text
    assert "LOST" in section(page, "tracking")
    assert "alert(1)" in page.text
    assert not page.tags & {"script", "b"}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("report.json", None),
        ("report.json", "{"),
        ("report.json", "[1, 2]"),
        ("report.json", '{"frames": "many"}'),
        ("trajectory.txt", None),
        ("trajectory.txt", "1.0 2.0"),
        ("frames.csv", "stamp_s,state\n1.0,UPSIDE_DOWN\n"),
        ("frames.csv", "stamp_s,state,tracking_ms\n1.0,OK,quick\n"),
    ],
)
def test_a_damaged_folder_is_refused_in_words(make_run, name, content):
    folder = make_run()
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_text(content)
    with pytest.raises(EvaluationError, match=re.escape(name)):
        read_run(folder)


def test_entries_of_any_kind_do_no_harm(make_run):
    strange = {
        "stage_ms": 3, "topics": {"color": 3, "mood": "x"}, "config": {"mapping": [1]},
        "camera": {"width": "wide"}, "machine": "big", "versions": [], "frame_range": "all",
        "ate_rmse_m": "small", "map_bytes": None, "seed": [],
    }  # fmt: skip
    page = made(make_run(**strange))
    assert "does not tell how long" in page.text


def meslam(*arguments: object):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def test_the_command_writes_into_the_runs_folder(make_run):
    folder = make_run()
    result = meslam(folder, "--views", 0)
    assert result.exit_code == 0, result.stderr
    assert str(folder / "report.html") in result.stdout
    assert "Results" in Page(folder / "report.html").text


def test_the_command_takes_truth_and_recording(make_run, finished_run, walk, tmp_path):
    folder = make_run(truth=None, recording_path=None)
    target = tmp_path / "new.html"
    options = ["--truth", finished_run.truth, "--recording", walk, "--views", 1, "--out", target]
    result = meslam(folder, *options)
    assert result.exit_code == 0, result.stderr
    page = Page(target)
    assert "cannot show" not in page.text
    assert len(page.images["camera image"]) == 1


@pytest.mark.parametrize("option", ["--truth", "--recording"])
def test_the_command_names_what_it_cannot_read(make_run, tmp_path, option):
    result = meslam(make_run(), option, tmp_path / "nothing.txt")
    assert result.exit_code == 2
    assert "nothing.txt" in result.stderr


def test_the_command_refuses_a_choice_that_does_not_fit(make_run, finished_run):
    truths = ["--truth", finished_run.truth] * 2
    result = meslam(*(make_run(name) for name in "abc"), *truths)
    assert result.exit_code == 2
    assert "2 times for 3 runs" in result.stderr


def test_a_place_that_cannot_be_written_is_named(make_run, tmp_path):
    result = meslam(make_run(), "--views", 0, "--out", tmp_path / "no" / "page.html")
    assert result.exit_code == 2
    assert "page.html" in result.stderr
