"""Whether the maps that a fault left behind load."""

from __future__ import annotations

from pathlib import Path

from meslam_core.errors import MeslamError
from meslam_core.map.store import MapStore


def lost_maps(folder: Path, harmed: tuple[str, ...] = ()) -> list[str]:
    """One sentence for every map below a folder that does not load whole, but for those named."""
    lost = []
    for path in sorted(folder.rglob("*.meslam")):
        if path.name in harmed or not path.is_dir():
            continue
        try:
            loaded = MapStore(path).load()
        except MeslamError as error:
            lost.append(f"lost map: {error}")
        else:
            lost += [f"lost map: {warning}" for warning in loaded.warnings]
            if not loaded.regions:
                lost.append(f"lost map: {path.name} holds no region")
    return lost
