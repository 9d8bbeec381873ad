"""The JSON metadata of an encoded region, checked field by field."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from meslam_core.errors import MapError
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.regions.grid import RegionIndex

PRECISIONS = ("int8", "fp16", "fp32")
MAX_MASK_COUNT = 448
MAX_INDEX = 2**31 - 1
MAX_STAMP_NS = 2**63 - 1
MAX_METERS = 1e7
RIGID_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Metadata:
    """What is stored of a region beside its tensors; names and units are `StoredRegion`'s."""

    index: RegionIndex
    T_map_region: tuple[tuple[float, ...], ...]
    side_m: float
    architecture: Architecture
    precision: str
    version: int
    stamp_ns: int
    keyframes: int
    mask_voxel_m: float
    mask_count: int
    mask_corner: tuple[int, int, int]
    mask_shape: tuple[int, int, int]

    @classmethod
    def of(
        cls,
        region: StoredRegion,
        precision: str,
        mask_corner: tuple[int, int, int],
        mask_shape: tuple[int, int, int],
    ) -> Metadata:
        """The metadata of a region about to be encoded."""
        return cls(
            index=region.index,
            T_map_region=tuple(tuple(map(float, row)) for row in region.T_map_region),
            side_m=float(region.side_m),
            architecture=region.architecture,
            precision=precision,
            version=region.version,
            stamp_ns=region.stamp_ns,
            keyframes=region.keyframes,
            mask_voxel_m=region.mask.voxel_m,
            mask_count=region.mask.flags.shape[0],
            mask_corner=mask_corner,
            mask_shape=mask_shape,
        )

    def to_json(self) -> str:
        """Compact JSON; floats are written so that they read back exactly."""
        return json.dumps(
            {
                "index": self.index,
                "T_map_region": self.T_map_region,
                "side_m": self.side_m,
                "architecture": vars(self.architecture),
                "precision": self.precision,
                "version": self.version,
                "stamp_ns": self.stamp_ns,
                "keyframes": self.keyframes,
                "mask": {
                    "voxel_m": self.mask_voxel_m,
                    "count": self.mask_count,
                    "corner": self.mask_corner,
                    "shape": self.mask_shape,
                },
            },
            separators=(",", ":"),
        )

    @classmethod
    def from_json(cls, text: Any, name: str) -> Metadata:
        """Metadata of a region read from `name`.

        Raises:
            MapError: when something is missing, of the wrong type or out of range.
        """
        try:
            values = json.loads(text)
            mask, network = values["mask"], values["architecture"]
            metadata = cls(
                index=_triple(values["index"]),
                T_map_region=tuple(tuple(map(_real, row)) for row in values["T_map_region"]),
                side_m=_real(values["side_m"]),
                architecture=Architecture(
                    width=_whole(network["width"]),
                    embedding=_whole(network["embedding"]),
                    truncation_m=_real(network["truncation_m"]),
                    density_scale=_real(network["density_scale"]),
                ),
                precision=str(values["precision"]),
                version=_whole(values["version"]),
                stamp_ns=_whole(values["stamp_ns"]),
                keyframes=_whole(values["keyframes"]),
                mask_voxel_m=_real(mask["voxel_m"]),
                mask_count=_whole(mask["count"]),
                mask_corner=_triple(mask["corner"]),
                mask_shape=_triple(mask["shape"]),
            )
        except KeyError as error:
            raise MapError(f"{name}: the metadata lacks {error}; it is damaged") from error
        except (ValueError, TypeError, RecursionError, OverflowError) as error:
            raise MapError(f"{name}: the metadata cannot be read ({error})") from error
        metadata.check(name)
        return metadata

    def check(self, name: str) -> None:
        """Refuse values that no region has; sizes are limited so that memory is.

        Raises:
            MapError: naming the value and its range.
        """
        network = self.architecture
        checks = (
            ("index", all(abs(value) <= MAX_INDEX for value in self.index)),
            ("T_map_region", _is_rigid(self.T_map_region)),
            ("side_m", 0.01 <= self.side_m <= 1000.0),
            ("architecture.width", 1 <= network.width <= 512),
            ("architecture.embedding", 1 <= network.embedding <= 512),
            ("architecture.truncation_m", 1e-3 <= network.truncation_m <= 10.0),
            ("architecture.density_scale", 1e-3 <= network.density_scale <= 1e6),
            ("precision", self.precision in PRECISIONS),
            ("version", 0 <= self.version <= MAX_INDEX),
            ("stamp_ns", 0 <= self.stamp_ns <= MAX_STAMP_NS),
            ("keyframes", 0 <= self.keyframes <= MAX_INDEX),
            ("mask.voxel_m", 1e-3 <= self.mask_voxel_m <= 100.0),
            ("mask.count", 2 <= self.mask_count <= MAX_MASK_COUNT and self.mask_count % 2 == 0),
            ("mask.corner", all(0 <= value <= self.mask_count for value in self.mask_corner)),
            ("mask.shape", all(0 <= value <= self.mask_count for value in self.mask_shape)),
        )
        for what, holds in checks:
            if not holds:
                raise MapError(f"{name}: {what} is out of range")


def _is_rigid(rows: tuple[tuple[float, ...], ...]) -> bool:
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        return False
    pose = np.array(rows)
    rotation = pose[:3, :3]
    return bool(
        np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
        and np.abs(pose[:3, 3]).max() <= MAX_METERS
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID_TOLERANCE)
        and np.linalg.det(rotation) > 0.0
    )


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r} is not a whole number")
    return value


def _real(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    if not math.isfinite(value):
        raise ValueError("numbers must be finite")
    return float(value)


def _triple(values: Any) -> tuple[int, int, int]:
    if not isinstance(values, list) or len(values) != 3:
        raise TypeError(f"{values!r} is not a list of three")
    return (_whole(values[0]), _whole(values[1]), _whole(values[2]))
