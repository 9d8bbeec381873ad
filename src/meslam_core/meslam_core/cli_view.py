"""The `meslam` command's page in the browser."""

from __future__ import annotations

import signal
import threading
from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from meslam_core.command_output import complain

app = typer.Typer()


@app.command()
def view(
    path: Annotated[
        Path, typer.Argument(metavar="RUN_OR_MAP", help="What `meslam run --out` wrote, or a map.")
    ],
    recording: Annotated[
        Path | None, typer.Option(help="Where the images are, if the recording was moved.")
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Of the page; if taken, the next free one.")
    ] = 8080,
    host: Annotated[
        str,
        typer.Option(
            help="Address to serve the page on; the default is for this computer alone, 0.0.0.0 "
            "for its network too: everybody there can then see and download the map."
        ),
    ] = "127.0.0.1",
    resolution: Annotated[
        float, typer.Option(min=0.01, max=0.2, help="Spacing of the mesh's vertices [m].")
    ] = 0.03,
) -> None:
    """Show a finished run, or a map, in the browser.

    The map, its regions, the path, the camera and what it saw, at any time of the run. For a
    running system there is `viewer_node`. Ctrl-C ends it.
    """
    from meslam_core.console import waiting
    from meslam_core.viewer.finished_run import FinishedRun
    from meslam_core.viewer.scene import ViewControls
    from meslam_core.viewer.viewer import Viewer

    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    controls = ViewControls(mesh_resolution_m=resolution)
    with closing(Viewer(host, port, controls, eager=True)) as viewer:
        with waiting("reading what the run left"):
            run = FinishedRun(viewer, path, recording)
        try:
            for line in run.missing:
                complain(line)
            typer.echo(f"{path} is shown on {viewer.page.url} (Ctrl-C ends it)")
            ended.wait()
        finally:
            run.close()
