"""The scenes that can be simulated, by name."""

from __future__ import annotations

from collections.abc import Callable

from meslam_core.errors import ConfigError
from meslam_core.simulation.building import building
from meslam_core.simulation.corridor import corridor
from meslam_core.simulation.library import library
from meslam_core.simulation.room import room
from meslam_core.simulation.scene import Scene

SCENES: dict[str, Callable[[], Scene]] = {
    "building": building,
    "corridor": corridor,
    "library": library,
    "room": room,
}


def build_scene(name: str) -> Scene:
    """The scene of a name; always the same one.

    Raises:
        ConfigError: when there is no such scene.
    """
    if name not in SCENES:
        raise ConfigError(f"there is no scene {name!r}; choose one of {', '.join(sorted(SCENES))}")
    return SCENES[name]()
