"""What map stores hold, for `meslam info`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meslam_core.map.stored_region import StoredRegion
from meslam_core.map.union import MapUnion

BOX_SAMPLES = 20
_COLUMNS = (
    "region",
    "center [m]",
    "keyframes",
    "bytes",
    "seen [m^3]",
    "bytes/m^3 seen",
    "/m^3 box",
)


def describe_maps(paths: Sequence[Path]) -> tuple[dict[str, Any], list[str]]:
    """Facts about a map, or several as one, in plain types, and a sentence for every damage.

    Raises:
        MapError: when one is no map, or nothing of it can be read.
    """
    union = MapUnion(paths)
    regions = union.regions
    low, high, volume_m3 = [0.0] * 3, [0.0] * 3, 0.0
    if regions:
        neural_map = union.neural_map()
        (low, high), volume_m3 = neural_map.bounds.tolist(), neural_map.observed_volume_m3
    box_m3 = box_volume_m3(regions)
    sizes = [_folder_bytes(path) for path in paths]
    facts: dict[str, Any] = {"format": "map store"}
    if len(paths) == 1:
        facts["map_id"] = union.maps[0].map_id
    facts |= {
        "regions": len(regions),
        "bytes": sum(sizes),
        "observed_volume_m3": volume_m3,
        "box_volume_m3": box_m3,
        "bytes_per_m3": _ratio(sum(sizes), volume_m3),
        "bytes_per_box_m3": _ratio(sum(sizes), box_m3),
    }
    if len(paths) == 1:
        grid = union.maps[0].grid
        facts |= {
            "region_side_m": float(grid.side_m),
            "region_overlap": float(grid.overlap),
            "lattice_origin_m": [float(value) for value in grid.origin],
        }
    facts |= {
        "bounds_low_m": [float(value) for value in low],
        "bounds_high_m": [float(value) for value in high],
        "keyframes": sum(region.keyframes for region in regions),
        "maps": [
            {"path": str(path), "map_id": each.map_id, "regions": len(each.regions), "bytes": size}
            for path, each, size in zip(paths, union.maps, sizes, strict=True)
        ],
        "region_list": [
            _region_facts(region, len(each.encoded[region.index]), str(path))
            for path, each in zip(paths, union.maps, strict=True)
            for region in sorted(each.regions, key=lambda region: region.index)
        ],
        "damages": union.damages,
    }
    return facts, union.damages


def region_table(facts: dict[str, Any]) -> list[str]:
    """The regions of `describe_maps` as lines of a table."""
    rows = [_COLUMNS]
    for region in facts["region_list"]:
        rows.append(
            (
                ",".join(map(str, region["index"])),
                " ".join(f"{value:.2f}" for value in region["center_m"]),
                str(region["keyframes"]),
                str(region["bytes"]),
                f"{region['observed_volume_m3']:.1f}",
                f"{region['bytes_per_m3']:.0f}",
                f"{region['bytes_per_box_m3']:.0f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]


def box_volume_m3(regions: Sequence[StoredRegion]) -> float:
    """Volume of the regions' boxes, counted once where they overlap [m^3].

    Good to about a hundredth: each box is sampled by 20 points a side.
    """
    axis = (np.arange(BOX_SAMPLES) + 0.5) / BOX_SAMPLES - 0.5
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    total = 0.0
    for number, region in enumerate(regions):
        points = region.side_m * unit @ region.T_map_region[:3, :3].T + region.T_map_region[:3, 3]
        new = np.ones(len(points), bool)
        for other in regions[:number]:
            if np.linalg.norm(_center(other) - _center(region)) < 2 * (
                other.side_m + region.side_m
            ):
                local = (points - _center(other)) @ other.T_map_region[:3, :3]
                new &= (np.abs(local) > other.half_side_m).any(axis=1)
        total += float(new.mean()) * region.side_m**3
    return total


def _region_facts(region: StoredRegion, size: int, path: str) -> dict[str, Any]:
    seen_m3 = region.mask.observed_volume_m3
    return {
        "map": path,
        "index": list(region.index),
        "center_m": [float(value) for value in _center(region)],
        "width": region.architecture.width,
        "embedding": region.architecture.embedding,
        "version": region.version,
        "keyframes": region.keyframes,
        "bytes": size,
        "observed_volume_m3": seen_m3,
        "bytes_per_m3": _ratio(size, seen_m3),
        "bytes_per_box_m3": _ratio(size, region.side_m**3),
    }


def _center(region: StoredRegion) -> np.ndarray[Any, np.dtype[np.float64]]:
    return region.T_map_region[:3, 3]


def _folder_bytes(path: Path) -> int:
    return sum(file.stat().st_size for file in path.iterdir() if file.is_file())


def _ratio(amount: float, volume_m3: float) -> float:
    return amount / volume_m3 if volume_m3 else 0.0
