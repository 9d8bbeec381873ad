"""Options that several commands of `meslam` share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from meslam_core.camera import PinholeCamera
    from meslam_core.recordings.topics import RecordingTopics

CameraOption = Annotated[
    Path | None,
    typer.Option(help="camera.json with width, height, fx, fy, cx, cy instead of the recording's."),
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="ROLE=TOPIC",
        help="Topic of a bag that is color, depth, color_info or depth_info, where its content "
        "does not tell; repeatable.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change a setting; repeatable."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]
LeverArmOption = Annotated[
    bool,
    typer.Option(
        "--lever-arm",
        help="The true poses are another sensor's on the same mount: find its place as well.",
    ),
]


def camera_of(path: Path | None) -> PinholeCamera | None:
    """The intrinsics in a file, if one is given."""
    from meslam_core.camera import PinholeCamera

    return None if path is None else PinholeCamera.from_json(path)


def topics_of(texts: list[str] | None) -> RecordingTopics:
    """The topics that are named."""
    from meslam_core.recordings.topics import RecordingTopics

    return RecordingTopics.from_texts(texts or [])
