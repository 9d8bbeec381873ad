"""Folders that requests may write to and read from, and nothing outside of them."""

from __future__ import annotations

from pathlib import Path

from meslam_core.errors import OutputError
from meslam_ros.answers import Code, RequestError

NAME_LIMIT = 255


def path_below(folder: str, name: str, parameter: str) -> Path:
    """A path below a folder, for names that lead nowhere else, links included.

    Args:
        folder: that a parameter of the node names.
        name: as requested, relative to it.
        parameter: its name, for the message.

    Raises:
        RequestError: when the name is none, or leads out of the folder.
    """
    root = Path(folder).expanduser().resolve()
    usable = bool(name) and len(name) <= NAME_LIMIT and "\0" not in name
    parts = Path(name).parts if usable else ()
    if not parts or Path(name).is_absolute() or ".." in parts:
        raise RequestError(
            Code.INVALID_REQUEST,
            f"{name!r} is not a name below the folder {root}; give one without a leading "
            f"'/' and without '..' (the parameter {parameter} chooses the folder)",
        )
    try:
        path = (root / name).resolve()
    except (OSError, RuntimeError) as error:
        raise RequestError(
            Code.INVALID_REQUEST, f"{name!r} cannot be followed below {root}: {error}"
        ) from error
    if root not in path.parents:
        raise RequestError(Code.INVALID_REQUEST, f"{name!r} leads out of the folder {root}")
    return path


def make_folder(path: Path) -> None:
    """Make a folder and those above it, where they are missing.

    Raises:
        OutputError: when that is not possible.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the folder {path} cannot be made: {error.strerror}; choose one that can"
        ) from error
