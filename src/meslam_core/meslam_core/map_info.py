"""What a map store holds, for `meslam info`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore


def describe_map(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Facts about a map in plain types, ready for JSON, and a sentence for every damage.

    Raises:
        MapError: when there is no map, or nothing of it can be read.
    """
    loaded = MapStore(path).load()
    low, high, volume_m3 = [0.0] * 3, [0.0] * 3, 0.0
    if loaded.regions:
        neural_map = NeuralMap(loaded.regions)
        (low, high), volume_m3 = neural_map.bounds.tolist(), neural_map.observed_volume_m3
    size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    facts = {
        "format": "map store",
        "map_id": loaded.map_id,
        "regions": len(loaded.regions),
        "bytes": size,
        "observed_volume_m3": volume_m3,
        "bytes_per_m3": size / volume_m3 if volume_m3 else 0.0,
        "region_side_m": float(loaded.grid.side_m),
        "region_overlap": float(loaded.grid.overlap),
        "lattice_origin_m": [float(value) for value in loaded.grid.origin],
        "bounds_low_m": [float(value) for value in low],
        "bounds_high_m": [float(value) for value in high],
        "keyframes": sum(region.keyframes for region in loaded.regions),
        "region_list": [
            {
                "index": list(region.index),
                "center_m": [float(value) for value in region.T_map_region[:3, 3]],
                "width": region.architecture.width,
                "embedding": region.architecture.embedding,
                "version": region.version,
                "keyframes": region.keyframes,
                "observed_volume_m3": region.mask.observed_volume_m3,
            }
            for region in sorted(loaded.regions, key=lambda each: each.index)
        ],
        "damages": list(loaded.warnings),
    }
    return facts, loaded.warnings
