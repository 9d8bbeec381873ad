"""The `meslam` command's part that works on stored maps, one or several in a common frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meslam_core.command_output import exit_if_damaged, print_entries

if TYPE_CHECKING:
    from meslam_core.map.union import MapUnion

app = typer.Typer()

MapsArgument = Annotated[
    list[Path],
    typer.Argument(metavar="MAP...", help="Map stores; several in one frame are taken as one map."),
]


@app.command()
def mesh(
    stored: MapsArgument,
    out: Annotated[Path, typer.Option(metavar="FILE.ply", help="The mesh file.")],
    resolution: Annotated[float, typer.Option(help="Spacing of the vertices [m].")] = 0.02,
) -> None:
    """Extract a map's coloured surface as a triangle mesh."""
    from meslam_core.console import counting_bar, error_console
    from meslam_core.map.mesh import extract_mesh
    from meslam_core.map.mesh_file import write_mesh

    union = _union(stored)
    with counting_bar(error_console(), "tiles") as progress:
        surface = extract_mesh(union.neural_map(), resolution, progress=progress)
    write_mesh(surface, out)
    typer.echo(f"{out}: {len(surface.vertices)} vertices, {len(surface.triangles)} triangles")
    _exit_if_damaged(stored, union)


@app.command()
def query(
    stored: MapsArgument,
    points: Annotated[Path, typer.Option(metavar="FILE.npy", help="(N, 3) floats, map frame [m].")],
    out: Annotated[Path, typer.Option(metavar="FILE.npy", help="The answers, one a point.")],
) -> None:
    """Ask a map about points.

    Writes a structured array (N,) with the fields occupancy (int8: -1 unknown, 0 free, 100
    occupied), probability (float32, of being occupied; 0.5 where unknown), density (float32,
    1/m; NaN where unknown), distance (float32, m: to the nearest surface, positive behind it; NaN
    where unknown) and color (3 uint8, RGB; meaningful near surfaces, 0 where unknown).
    """
    from meslam_core.console import counting_bar, error_console
    from meslam_core.point_query import answer, read_points, write_answers

    wanted = read_points(points)
    union = _union(stored)
    with counting_bar(error_console(), "points") as progress:
        answers = answer(union.neural_map(), wanted, progress)
    write_answers(out, answers)
    typer.echo(f"{out}: {len(wanted)} answers")
    _exit_if_damaged(stored, union)


@app.command()
def merge(
    stored: MapsArgument,
    out: Annotated[Path, typer.Option(metavar="MAP", help="Folder of the merged map.")],
) -> None:
    """Store several maps in a common frame as one.

    The first map's lattice becomes the merged map's: a robot that continues it extends that one.
    Regions of all maps are kept as they are and blended where they overlap.
    """
    from meslam_core.console import waiting

    union = _union(stored)
    with waiting("writing the map"):
        count = union.save(out)
    typer.echo(f"{out}: {count} regions of {len(stored)} maps")
    _exit_if_damaged(stored, union)


def describe(paths: list[Path], as_json: bool) -> None:
    """Print what maps hold."""
    from meslam_core.console import waiting

    with waiting("reading the map"):
        from meslam_core.map_info import describe_maps, region_table

        facts, damages = describe_maps(paths)
    if as_json:
        print_entries(facts, as_json)
    else:
        listed = {"region_list"} | ({"maps"} if len(paths) == 1 else set())
        print_entries({key: facts[key] for key in facts if key not in listed}, as_json)
        typer.echo("\n".join(region_table(facts)))
    exit_if_damaged(" or ".join(map(str, paths)), damages)


def _union(paths: list[Path]) -> MapUnion:
    from meslam_core.console import waiting

    with waiting("reading the map"):
        from meslam_core.map.union import MapUnion

        return MapUnion(paths)


def _exit_if_damaged(paths: list[Path], union: MapUnion) -> None:
    exit_if_damaged(" or ".join(map(str, paths)), union.damages)
