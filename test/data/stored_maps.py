"""What tests ask of a stored map's folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion

Regions = list[StoredRegion]


def changed(region: StoredRegion) -> StoredRegion:
    parameters = region.parameters + np.float32(0.25)
    return replace(region, parameters=parameters, version=region.version + 1)


def region_files(store: MapStore) -> list[Path]:
    return sorted(store.path.glob("region_*.msr"))


def versions(store: MapStore) -> dict[tuple[int, int, int], int]:
    loaded = store.load()
    assert not loaded.warnings
    return {region.index: region.version for region in loaded.regions}


def resealed(document: dict[str, Any]) -> bytes:
    """A manifest of any content with a checksum that is right."""
    document["sha256"] = "0" * 64
    blank = json.dumps(document, indent=1).encode() + b"\n"
    return blank.replace(b"0" * 64, hashlib.sha256(blank).hexdigest().encode())
