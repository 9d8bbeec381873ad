"""Writes a simulation as a recording, with its truth beside it and never inside."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import open3d as o3d

from meslam_core.errors import OutputError
from meslam_core.recordings.writer import convert
from meslam_core.simulation.simulator import Simulation
from meslam_core.trajectory import write_tum


def truth_path(recording: Path) -> Path:
    """Where the true poses of a simulated recording lie: T_scene_camera as TUM text."""
    return Path(recording).with_suffix(".truth.txt")


def surface_path(recording: Path) -> Path:
    """Where the true surface of a simulated recording lies: a mesh in the scene's frame [m]."""
    return Path(recording).with_suffix(".surface.ply")


def write_simulation(
    simulation: Simulation,
    target: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write FILE.mcap, FILE.truth.txt and FILE.surface.ply; the recording appears last.

    Args:
        simulation: what to render.
        target: name of the .mcap file; existing files are replaced at the end.
        progress: called with the number of frames written and their total.

    Raises:
        OutputError: when a file cannot be written; then nothing is left behind.
    """
    target = Path(target)
    if target.suffix != ".mcap" or target.is_dir():
        raise OutputError(f"{target} is not a file name that ends in .mcap; choose one that does")
    partial = target.with_name(f".{target.stem}.{os.getpid()}.mcap")
    pairs = [
        (truth_path(partial), truth_path(target)),
        (surface_path(partial), surface_path(target)),
        (partial, target),
    ]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_tum(pairs[0][0], simulation.truth)
        if not o3d.io.write_triangle_mesh(pairs[1][0], simulation.surface):
            raise OutputError(f"{surface_path(target)} cannot be written; is there space left?")
        convert(simulation, partial, progress)
        for source, destination in pairs:
            source.replace(destination)
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written ({error}); choose a folder that is writable"
        ) from error
    finally:
        for source, _ in pairs:
            with suppress(OSError):
                source.unlink()
