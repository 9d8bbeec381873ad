"""A stored map that another session goes on with, in the same frame."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from meslam_core.config import FieldConfig, MeslamConfig
from meslam_core.errors import ConfigError, MapError
from meslam_core.field import make_field
from meslam_core.map import codec
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.mapping.keyframes import KeyframeStore
from meslam_core.mapping.replay import remembered_views
from meslam_core.regions.atlas import RegionAtlas
from meslam_core.regions.grid import RegionGrid
from meslam_core.regions.region import Region, RegionOrigin
from meslam_core.scratch import ScratchFile
from meslam_core.se3 import Pose, from_quaternion
from meslam_core.trajectory import read_tum

# What stands for the old session's keyframes: so many views of a region. Where nothing is trained
# they are only what poses are given by.
VIEWS_A_REGION = 24
VIEWS_TO_LOCALISE = 1
POSE_VALUES = 7


@dataclass(frozen=True)
class Continuation:
    """A map to go on with.

    Attributes:
        map_id: of the map; it keeps it.
        grid: the lattice.
        regions: what is stored, and the bytes that it is stored as.
        T_map_camera: (4, 4), where the camera is in it at first: within a few centimetres and
            degrees, which the first image then corrects.
        train: whether the map is trained further; else poses are only found in it.
    """

    map_id: str
    grid: RegionGrid
    regions: list[tuple[StoredRegion, bytes]]
    T_map_camera: Pose
    train: bool = True

    @classmethod
    def read(cls, path: Path, T_map_camera: Pose) -> Continuation:
        """A map's folder.

        Raises:
            MapError: when it is not there or damaged: what is missing would be mapped anew.
        """
        store = MapStore(path)
        loaded = store.load()
        if loaded.warnings:
            raise MapError(
                f"{path} cannot be continued: {loaded.warnings[0]}; "
                "restore a copy, or start a new map"
            )
        if not loaded.regions:
            raise MapError(f"{path} holds no region to continue; start a new map, without --map")
        regions = []
        for entry in store.manifest().regions:
            data = loaded.encoded[entry.index]
            regions.append((codec.decode(data, entry.file), data))
        return cls(loaded.map_id, loaded.grid, regions, T_map_camera)

    def adapted(self, config: MeslamConfig) -> MeslamConfig:
        """A configuration with the map's own networks, boxes and masks.

        Loops are not closed: nothing of the old session remains that a view could be found in.

        Raises:
            MapError: when the map's regions differ among each other.
        """
        first = self.regions[0][0]
        shape = first.mask.flags.shape
        for region, _ in self.regions:
            if region.architecture != first.architecture or region.mask.flags.shape != shape:
                raise MapError(
                    "the map's regions have different networks or masks; "
                    "continue one of the maps it was merged of"
                )
        own = first.architecture
        field = replace(
            config.field,
            width=own.width,
            embedding=own.embedding,
            truncation_m=own.truncation_m,
            density_scale=own.density_scale,
        )
        regions = replace(
            config.regions,
            volume_m3=self.grid.side_m**3,
            overlap=self.grid.overlap,
            mask_voxel_m=first.mask.voxel_m,
            # Half a voxel less, for a mask is rounded up to whole ones.
            mask_extent=(first.mask.half_extent_m - 0.5 * first.mask.voxel_m) / first.half_side_m,
            close_loops=False,
        )
        return replace(config, field=field, regions=regions)

    def atlas(
        self, config: MeslamConfig, keyframes: KeyframeStore, seed: int, scratch: ScratchFile
    ) -> RegionAtlas:
        """The regions at rest, each with views of its own as keyframes that do not move.

        Args:
            config: as `adapted`.
            keyframes: empty; the views are added.
            seed: of the views, and of networks to come.
            scratch: where the regions rest.
        """
        generator = np.random.default_rng(seed)
        regions = []
        count = VIEWS_A_REGION if self.train else VIEWS_TO_LOCALISE
        for stored, data in self.regions:
            region = _awake(stored, data, config.field)
            views = remembered_views(region, count, config.keyframes.rays, generator)
            for T_map_view, rays in views:
                region.keyframes.append(keyframes.add(stored.stamp_ns, T_map_view, rays))
            region.rest(scratch)
            regions.append(region)
        keyframes.fixed = len(keyframes)
        for region in regions:
            region.seen = len(keyframes)
        atlas = RegionAtlas(config, self.T_map_camera[:3, 3], keyframes, seed, scratch)
        atlas.take_over(self.grid, regions, self.T_map_camera[:3, 3])
        return atlas


def read_continuation(path: Path | None, start_pose: str) -> Continuation | None:
    """What `--map` and `--start-pose` ask for; None without a map.

    Raises:
        ConfigError: when one is given without the other, or the pose is malformed.
        EvaluationError: when the pose's file cannot be read.
        MapError: when the map cannot.
    """
    if path is None and not start_pose:
        return None
    if path is None or not start_pose:
        raise ConfigError("--map and --start-pose belong together; give both")
    return Continuation.read(path, read_start_pose(start_pose))


def read_start_pose(text: str) -> Pose:
    """T_map_camera (4, 4) from "x y z qx qy qz qw", or from the first line of a TUM file.

    Raises:
        ConfigError: when the text is neither.
        EvaluationError: when the file cannot be read.
    """
    values = text.replace(",", " ").split()
    if len(values) != POSE_VALUES:
        # A text that is too long for a path, or holds what no path may, is an error to the system.
        with suppress(OSError, ValueError):
            if Path(text).is_file():
                return np.asarray(read_tum(Path(text)).poses[0], np.float64)
        raise ConfigError(
            f"--start-pose {text!r} is neither 'x y z qx qy qz qw' nor a file with poses"
        )
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError as error:
        raise ConfigError(
            f"--start-pose {text!r} holds something that is no number; "
            "give seven: x y z qx qy qz qw"
        ) from error
    norm = float(np.linalg.norm(numbers[3:]))
    if not np.isfinite(numbers).all() or not 0.9 < norm < 1.1:
        raise ConfigError(f"--start-pose {text!r} needs a finite position and a unit quaternion")
    return from_quaternion(numbers[:3], numbers[3:] / norm)


def _awake(stored: StoredRegion, data: bytes, config: FieldConfig) -> Region:
    assert Architecture.of(config) == stored.architecture
    field = make_field(config, 0)
    field.load_flat(stored.parameters)
    region = Region(
        stored.index,
        stored.T_map_region,
        stored.side_m,
        field,
        stored.mask,
        version=stored.version,
    )
    region.origin = RegionOrigin(stored.version, data)
    return region
