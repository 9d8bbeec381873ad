"""The page that shows the demo while it runs."""

from __future__ import annotations

import contextlib
import re
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console

from meslam_ros.processes import NodeProcess, ros_arguments

URL = re.compile(r"shown on (http://\S+)")
POLL_S = 0.2


@contextlib.contextmanager
def live_page(console: Console, port: int) -> Iterator[None]:
    """A viewer that lives as long as the block, and a line that says where.

    Args:
        console: for the line.
        port: of the page, or the next free one; negative for no page.
    """
    if port < 0:
        yield
        return
    ended = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        viewer = NodeProcess(
            "viewer_node", ros_arguments({"port": port}), log=Path(folder, "viewer.log")
        )
        teller = threading.Thread(target=_tell, args=(console, viewer, ended), daemon=True)
        teller.start()
        try:
            yield
        finally:
            ended.set()
            teller.join()
            viewer.stop()


def _tell(console: Console, viewer: NodeProcess, ended: threading.Event) -> None:
    """Say where the page is, as soon as it is there."""
    while not ended.wait(POLL_S):
        if found := URL.search(viewer.output()):
            console.print(f"watch it live in the browser: {found[1]}", highlight=False)
            return
        if viewer.status is not None:
            console.print(f"there is no live page:\n{viewer.output()}", highlight=False)
            return
