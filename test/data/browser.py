"""A real browser without a window, for the viewer's page."""

from __future__ import annotations

import io
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
# Without a graphics card the processor draws, which takes a small window and patience.
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WINDOW = {"width": 760, "height": 420}
WAIT_S = 90.0
POLL_MS = 250

WORKING = (107, 205, 124)
"""The working region's colour, as the browser draws its lines."""

Pixels = NDArray[np.uint8]


@contextmanager
def open_browser() -> Iterator[Browser]:
    """A browser; the test is skipped where none is installed."""
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        reason = "no Chromium is installed: MESLAM_BROWSER=1 make setup"
        if os.environ.get("MESLAM_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()


def open_page(browser: Browser, url: str, requested: list[str] | None = None) -> Page:
    """A page as soon as it shows the viewer's panel.

    Args:
        browser: to open it in.
        url: of the page.
        requested: gets the addresses that it asks for.
    """
    page = browser.new_page(viewport=WINDOW, accept_downloads=True)
    page.set_default_timeout(1000.0 * WAIT_S)
    if requested is not None:
        page.on("request", lambda request: requested.append(request.url))
    page.goto(url)
    page.get_by_role("button", name="Overview").wait_for()
    notice = page.locator(".mantine-Notification-closeButton")
    if notice.count():
        click(page, ".mantine-Notification-closeButton")
    return page


def click(page: Page, selector: str) -> None:
    """Click without waiting for the page to stand still, which a busy computer's never does."""
    page.locator(selector).first.evaluate("element => element.click()")


def checkbox(page: Page, label: str) -> None:
    """Click the box with a label."""
    page.get_by_label(label, exact=True).first.evaluate("element => element.click()")


def screenshot(page: Page, save: Path | None = None) -> Pixels:
    """(H, W, 3) uint8 RGB of the window."""
    data = page.screenshot(timeout=1000.0 * WAIT_S)
    if save is not None:
        save.write_bytes(data)
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def count(pixels: Pixels, color: tuple[int, int, int], tolerance: int = 40) -> int:
    """How many pixels have a colour, every channel within the tolerance."""
    away = np.abs(pixels.astype(int) - np.array(color)).max(axis=2)
    return int(np.count_nonzero(away <= tolerance))


def wait_for(
    page: Page, what: str, holds: Callable[[Pixels], bool], save: Path | None = None
) -> Pixels:
    """The first screenshot of which something holds."""
    deadline = time.monotonic() + WAIT_S
    while not holds(pixels := screenshot(page, save)):
        assert time.monotonic() < deadline, f"{what} is not seen after {WAIT_S:.0f} s"
        page.wait_for_timeout(POLL_MS)
    return pixels


def wait_for_text(page: Page, text: str) -> None:
    """Wait until the page says something."""
    page.get_by_text(text).first.wait_for(state="attached")
