"""Fuzzing of what a map is stored and sent as: regions, manifests, folders."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
from data.analytic_scene import GRID, SIDE_M
from fuzz.mutation import Parts, mutated_bytes, mutated_text
from fuzz.region_bytes import content_of, mutated_manifest, mutated_region
from fuzz.target import Target

from meslam_core.config import FieldConfig
from meslam_core.errors import MapError
from meslam_core.field import make_field
from meslam_core.map import codec
from meslam_core.map.manifest import Manifest
from meslam_core.map.metadata import Metadata
from meslam_core.map.placed_region import PlacedRegion
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.map.union import MapUnion
from meslam_core.map_info import describe_maps
from meslam_core.point_query import answer, read_points
from meslam_core.regions.observed_mask import ObservedMask


def small_region(index: tuple[int, int, int] = (0, 0, 0), seed: int = 7) -> StoredRegion:
    """A region of a few hundred bytes with a random network."""
    config = FieldConfig(width=16, embedding=8, backend="torch")
    mask = ObservedMask(0.4, 0.1)
    mask.flags[2:5, 3:6, 1:2] = 3
    T_map_region = np.eye(4)
    T_map_region[:3, 3] = GRID.center(index)
    return StoredRegion(
        index=index,
        T_map_region=T_map_region,
        side_m=SIDE_M,
        architecture=Architecture.of(config),
        parameters=make_field(config, seed).flat(),
        mask=mask,
        version=4,
        stamp_ns=1_700_000_000_123_456_789,
        keyframes=9,
    )


@cache
def encoded_regions() -> tuple[bytes, ...]:
    """One of every precision, and one that observed nothing."""
    region = small_region()
    empty = replace(region, mask=ObservedMask(0.4, 0.1))
    return (*(codec.encode(region, each) for each in ("int8", "fp16", "fp32")), codec.encode(empty))


def use_region(region: StoredRegion) -> str:
    """Ask a region that was accepted, and store it again."""
    placed = PlacedRegion(region, "torch")
    values = placed.predict(np.zeros((2, 3), np.float32))
    assert values.shape == (2, 4)
    placed.lookup(np.zeros((2, 3), np.float32))
    again = codec.decode(codec.encode(region, "fp32"))
    np.testing.assert_array_equal(again.parameters, region.parameters)
    np.testing.assert_array_equal(again.mask.flags, region.mask.flags)
    return f"{region.architecture.width} {region.mask.flags.shape[0]}"


def _region(parts: Parts, folder: Path) -> str:
    region = codec.decode(parts["region"])
    precision = codec.precision_of(parts["region"])
    return f"{precision} {use_region(region)}"


def _mutated_region(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    return {"region": mutated_region(parts["region"], rng.choice(others)["region"], rng)}


def _metadata_seeds() -> list[Parts]:
    content = content_of(encoded_regions()[0])
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    return [{"metadata.json": header["__metadata__"]["meslam"].encode()}]


def _metadata(parts: Parts, folder: Path) -> str:
    metadata = Metadata.from_json(parts["metadata.json"].decode("latin-1"), "metadata")
    return f"{metadata.precision} {metadata.mask_count}"


@cache
def stored_map() -> tuple[tuple[str, bytes], ...]:
    """The files of a map of two regions."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        store = MapStore(Path(folder) / "a.meslam")
        regions = [small_region(), small_region((1, 0, 0), 8)]
        store.save(regions, GRID, "0123456789abcdef", nodes=[{"a": 1}])
        return tuple((path.name, path.read_bytes()) for path in sorted(store.path.iterdir()))


def _manifest(parts: Parts, folder: Path) -> str:
    manifest = Manifest.from_bytes(parts["manifest.json"], "manifest")
    again = Manifest.from_bytes(manifest.to_bytes(), "manifest")
    assert again.regions == manifest.regions
    assert again.map_id == manifest.map_id
    manifest.grid.center((1, 2, 3))
    return str(len(manifest.regions))


def _mutated_manifest(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    data = parts["manifest.json"]
    return {"manifest.json": mutated_manifest(data, rng.choice(others)["manifest.json"], rng)}


def _mutated_store(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    result = dict(parts)
    name = rng.choice(sorted(result))
    other = rng.choice(others).get(name, result[name])
    kind = rng.randrange(8)
    if kind == 0:
        del result[name]
    elif kind == 1:
        result[rng.choice(sorted(result))] = result[name]
    elif name == "manifest.json":
        result[name] = mutated_manifest(result[name], other, rng)
    else:
        result[name] = mutated_region(result[name], other, rng)
    return result


def _store(parts: Parts, folder: Path) -> str:
    """Load, ask, describe, merge, and save another map over what is there."""
    path = folder / "map.meslam"
    path.mkdir()
    for name, data in parts.items():
        (path / name).write_bytes(data)
    refused = 0
    try:
        loaded = MapStore(path).load()
        describe_maps([path])
        MapUnion([path]).save(folder / "merged.meslam")
        merged = MapStore(folder / "merged.meslam").load()
        assert len(merged.regions) == len(loaded.regions)
    except MapError:
        refused = 1
    try:
        found = len(MapStore(path).load(recover=True).regions)
    except MapError:
        found = 0
    MapStore(path).save([small_region()], GRID)
    assert len(MapStore(path).load().regions) == 1
    return f"{refused} {found}"


def _points_seeds() -> list[Parts]:
    import io

    seeds = []
    for array in (np.zeros((3, 3)), np.ones((2, 3), np.float32), np.arange(6).reshape(2, 3)):
        file = io.BytesIO()
        np.save(file, array, allow_pickle=False)
        seeds.append({"points.npy": file.getvalue()})
    return seeds


def _mutated_points(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """The header is text: mutated as such, in its length or as bytes."""
    data, other = parts["points.npy"], rng.choice(others)["points.npy"]
    if rng.random() < 0.5:
        return {"points.npy": mutated_bytes(data, other, rng)}
    header = mutated_text(data[10:128], other[10:128], rng)[:60000]
    if rng.random() < 0.8:
        header = header.replace(b"\n", b"").ljust(118)[:-1] + b"\n"
    return {"points.npy": data[:8] + len(header).to_bytes(2, "little") + header + data[128:]}


def _points(parts: Parts, folder: Path) -> str:
    from meslam_core.map.neural_map import NeuralMap

    path = folder / "points.npy"
    path.write_bytes(parts["points.npy"])
    points = read_points(path)
    answers = answer(NeuralMap([small_region()], backend="torch"), points)
    assert len(answers) == len(points)
    return str(points.shape)


TARGETS = [
    Target(
        "region",
        "an encoded region: header, compression, tensors, metadata, mask",
        lambda: [{"region": data} for data in encoded_regions()],
        _region,
        _mutated_region,
    ),
    Target("metadata", "the metadata of a region", _metadata_seeds, _metadata),
    Target(
        "manifest",
        "the manifest of a map",
        lambda: [{"manifest.json": dict(stored_map())["manifest.json"]}],
        _manifest,
        _mutated_manifest,
    ),
    Target(
        "map store",
        "a map's folder: loaded, described, merged, written over",
        lambda: [dict(stored_map())],
        _store,
        _mutated_store,
    ),
    Target("points", "points to ask about (.npy)", _points_seeds, _points, _mutated_points),
]
