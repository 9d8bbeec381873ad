"""The `meslam` command's part that looks at recordings, converts and simulates them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from meslam_core import cli_map
from meslam_core.cli_options import CameraOption, JsonOption, TopicOption, camera_of, topics_of
from meslam_core.command_output import print_entries

app = typer.Typer()


def _scenes() -> list[str]:
    from meslam_core.simulation.scenes import SCENES

    return list(SCENES)


@app.command()
def info(
    paths: Annotated[list[Path], typer.Argument(metavar="RECORDING_OR_MAP...")],
    camera: CameraOption = None,
    topics: TopicOption = None,
    as_json: JsonOption = False,
) -> None:
    """Tell what a recording or a map holds; several maps in one frame are taken as one."""
    path = paths[0]
    stored = path.is_dir() and ((path / "manifest.json").exists() or path.suffix == ".meslam")
    if stored or len(paths) > 1:
        cli_map.describe(paths, as_json)
        return
    from meslam_core.console import waiting

    with waiting(f"looking into {path.name}"):
        from meslam_core.recordings import describe, open_recording

        recording = open_recording(path, camera_of(camera), topics_of(topics))
        try:
            facts = describe(recording)
        finally:
            recording.close()
    print_entries(facts, as_json)


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A recording of any kind.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET.mcap")],
    camera: CameraOption = None,
    topics: TopicOption = None,
) -> None:
    """Convert a recording to an .mcap file with depth registered to colour."""
    from meslam_core.console import counting_bar, error_console, waiting
    from meslam_core.recordings import convert as write_frames
    from meslam_core.recordings import open_recording

    with waiting(f"looking into {source.name}"):
        recording = open_recording(source, camera_of(camera), topics_of(topics))
    try:
        with counting_bar(error_console(), "frames") as progress:
            count = write_frames(recording, target, progress)
    finally:
        recording.close()
    typer.echo(f"{target}: {count} frames")


@app.command()
def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="The space to walk through: building, corridor, library or room.",
            autocompletion=_scenes,
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE.mcap", help="The recording.")],
    duration: Annotated[
        float | None, typer.Option(help="Length of the recording [s]; by default one round.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of path and noise.")] = 0,
    fps: Annotated[float, typer.Option(help="Frames a second.")] = 15.0,
    motion_blur: Annotated[
        float, typer.Option(help="Exposure time during which the image smears [s].")
    ] = 0.0,
) -> None:
    """Record a simulated hand-held camera, with the true poses and surface beside it.

    FILE.truth.txt holds the poses in TUM format, FILE.surface.ply the surface.
    """
    from meslam_core.console import counting_bar, error_console, waiting
    from meslam_core.simulation.simulator import simulate as simulated
    from meslam_core.simulation.writer import truth_path, write_simulation

    with waiting("building the scene"):
        simulation = simulated(scene, duration, seed, fps=fps, motion_blur_s=motion_blur)
    with counting_bar(error_console(), "frames") as progress:
        write_simulation(simulation, out, progress)
    typer.echo(f"{out}: {len(simulation)} frames; true poses in {truth_path(out)}")
