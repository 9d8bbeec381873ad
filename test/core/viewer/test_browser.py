"""The viewer's page in a real browser: a finished run."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import trimesh
from core.viewer.conftest import FRAMES, IMAGE_COLORS
from data.browser import WORKING, checkbox, count, open_browser, open_page, wait_for, wait_for_text
from playwright.sync_api import Page

from meslam_core.viewer.finished_run import FinishedRun
from meslam_core.viewer.scene import ViewControls
from meslam_core.viewer.viewer import Viewer

BALL = (230, 26, 26)
MANY, SOME = 300, 40


@pytest.fixture(scope="module")
def viewer(run_folder: Path) -> Iterator[Viewer]:
    controls = ViewControls(mesh_resolution_m=0.06)
    with closing(Viewer(port=0, controls=controls, eager=True)) as viewer:
        run = FinishedRun(viewer, run_folder)
        assert run.missing == []
        yield viewer
        run.close()


@pytest.fixture(scope="module")
def requested() -> list[str]:
    """Addresses that the page has asked for."""
    return []


@pytest.fixture(scope="module")
def page(viewer: Viewer, requested: list[str]) -> Iterator[Page]:
    with open_browser() as browser:
        yield open_page(browser, viewer.page.url, requested)


def test_mesh_regions_camera_and_figures_are_seen(page: Page) -> None:
    wait_for(page, "the ball", lambda seen: count(seen, BALL) > MANY)
    wait_for(page, "the first image", lambda seen: count(seen, IMAGE_COLORS[0], 12) > MANY)
    for text in ("FINISHED", "12.5 frames/s", f"{FRAMES} tracked", "bytes/m³", "triangles"):
        wait_for_text(page, text)


def test_nothing_is_fetched_from_elsewhere(page: Page, viewer: Viewer, requested) -> None:
    assert requested
    assert [
        url for url in requested if not url.startswith((viewer.page.url, "data:", "blob:"))
    ] == []


def test_layers_can_be_hidden(page: Page) -> None:
    checkbox(page, "Mesh")
    seen = wait_for(page, "a view without mesh", lambda seen: count(seen, BALL) < SOME)
    assert count(seen, WORKING, 12) > SOME
    checkbox(page, "Regions")
    wait_for(page, "a view without regions", lambda seen: count(seen, WORKING, 12) == 0)
    checkbox(page, "Regions")
    checkbox(page, "Mesh")
    wait_for(page, "the ball", lambda seen: count(seen, BALL) > MANY)


def test_the_slice_of_occupancy_is_seen(page: Page, viewer: Viewer) -> None:
    checkbox(page, "Mesh")
    checkbox(page, "Occupancy")
    wait_for(page, "occupied cells", lambda seen: count(seen, (240, 58, 58), 25) > SOME)
    shown = viewer.scene.occupancy.value
    assert shown is not None
    assert set(np.unique(shown.cells)) == {-1, 0, 100}
    checkbox(page, "Occupancy")
    checkbox(page, "Mesh")


def test_the_run_is_replayed(page: Page, viewer: Viewer) -> None:
    checkbox(page, "Play")
    wait_for(page, "the last image", lambda seen: count(seen, IMAGE_COLORS[1], 12) > MANY)
    for _ in range(600):
        if len(viewer.scene.online_path.value) == FRAMES:
            break
        page.wait_for_timeout(100)
    assert len(viewer.scene.online_path.value) == FRAMES
    camera = viewer.scene.camera.value
    assert camera is not None
    assert camera.T_map_camera[1, 3] == pytest.approx(0.08 * (FRAMES - 1) - 0.5)
    page.wait_for_function("() => !document.querySelector('input[type=checkbox]').checked")


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_a_click_downloads_the_mesh(page: Page, suffix: str) -> None:
    with page.expect_download() as download:
        page.get_by_role("button", name=suffix).evaluate("element => element.click()")
    assert download.value.suggested_filename == f"meslam{suffix}"
    content = Path(download.value.path()).read_bytes()
    mesh = trimesh.load(io.BytesIO(content), file_type=suffix[1:], force="mesh")
    assert len(mesh.faces) > 1000
    assert np.allclose(np.abs(mesh.bounds), 1.4, atol=0.05)
