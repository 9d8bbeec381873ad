"""Another program: reads a map by the steps of `docs/map-format.md`, with nothing of the package.

json, zstandard and numpy are all it takes.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from data.analytic_scene import GRID

from meslam_core.map.neural_map import NeuralMap
from meslam_core.map.store import MapStore
from meslam_core.map.stored_region import StoredRegion
from meslam_core.regions.observed_mask import ObservedMask

TYPES = {"F32": "<f4", "F16": "<f2", "I8": "i1", "I16": "<i2", "U8": "u1", "U32": "<u4"}
PRECISIONS = ("int8", "fp16", "fp32")


@dataclass
class ForeignRegion:
    metadata: dict[str, Any]
    weights: dict[str, np.ndarray]
    mask: np.ndarray

    def ask(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Mask bits, f, colour and distance to the centre of points (N, 3)."""
        T_map_region = np.array(self.metadata["T_map_region"])
        q = (points - T_map_region[:3, 3]) @ T_map_region[:3, :3]
        w = self.weights

        def layer(name: str, inputs: np.ndarray) -> np.ndarray:
            return inputs @ w[f"{name}.weight"].T + w[f"{name}.bias"]

        x = q / (self.metadata["side_m"] / 2)
        e = np.sin(x @ w["encoding.frequencies"].T + w["encoding.phases"])
        h = np.maximum(layer("layer1", e), 0)
        h = np.maximum(layer("layer2", h), 0)
        h = np.maximum(layer("layer3", np.concatenate([h, e], axis=1)), 0)
        h = np.maximum(layer("layer4", h), 0)
        o = layer("head", h)
        voxels = np.floor(q / self.metadata["mask"]["voxel_m"]).astype(int) + len(self.mask) // 2
        inside = ((voxels >= 0) & (voxels < len(self.mask))).all(axis=1)
        bits = np.zeros(len(points), int)
        bits[inside] = self.mask[tuple(voxels[inside].T)]
        return bits, o[:, 0], 1 / (1 + np.exp(-o[:, 1:])), np.linalg.norm(q, axis=1)


def read_map(folder: Path) -> list[ForeignRegion]:
    text = (folder / "manifest.json").read_bytes()
    manifest = json.loads(text)
    assert (manifest["format"], manifest["version"]) == ("meslam-map", 1)
    digest = manifest["sha256"].encode()
    assert hashlib.sha256(text.replace(digest, b"0" * 64)).hexdigest().encode() == digest
    regions = []
    for entry in manifest["regions"]:
        data = (folder / entry["file"]).read_bytes()
        assert len(data) == entry["bytes"]
        assert hashlib.sha256(data).hexdigest() == entry["sha256"]
        regions.append(read_region(data))
        assert regions[-1].metadata["index"] == entry["index"]
    return regions


def read_region(data: bytes) -> ForeignRegion:
    magic, version, flags, packed, unpacked = struct.unpack("<8sIIQQ", data[:32])
    payload = data[64:]
    assert (magic, version, flags, packed) == (b"MESLAMRG", 1, 0, len(payload))
    assert hashlib.sha256(data[:32] + payload).digest() == data[32:64]
    content = zstandard.decompress(payload)
    assert len(content) == unpacked
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    metadata = json.loads(header.pop("__metadata__")["meslam"])
    tensors = {}
    for name, each in header.items():
        first, end = each["data_offsets"]
        values = np.frombuffer(content[8 + length :][first:end], TYPES[each["dtype"]])
        tensors[name] = values.reshape(each["shape"])
    mask = read_mask(tensors, metadata["mask"])
    weights = {}
    for name, values in tensors.items():
        if name.startswith("mask.") or name.endswith(".scale"):
            continue
        weights[name] = values.astype(np.float32)
        if name + ".scale" in tensors:
            scale = tensors[name + ".scale"]
            rows = weights[name].reshape(len(scale), -1) * scale[:, None]
            weights[name] = rows.reshape(values.shape)
    return ForeignRegion(metadata, weights, mask)


def read_mask(tensors: dict[str, np.ndarray], mask: dict[str, Any]) -> np.ndarray:
    shape = tuple(mask["shape"])
    order = sorted(np.ndindex(shape), key=lambda v: (4 * v[0] + 2 * v[1] + v[2], v))
    observed = read_bits(tensors, "mask.observed", order, {})
    unseen = {
        (x, y, z): sum(
            not observed.get(v)
            for v in (
                (x - 1, y, z), (x + 1, y, z), (x, y - 1, z),
                (x, y + 1, z), (x, y, z - 1), (x, y, z + 1),
            )
        )
        for x, y, z in order
    }  # fmt: skip
    near = read_bits(tensors, "mask.near", [v for v in order if observed[v]], unseen)
    whole = np.zeros((mask["count"],) * 3, np.uint8)
    for voxel, bit in observed.items():
        whole[tuple(np.add(voxel, mask["corner"]))] = bit + 2 * near.get(voxel, 0)
    return whole


def read_bits(
    tensors: dict[str, np.ndarray],
    name: str,
    order: list[tuple[int, int, int]],
    extra: dict[tuple[int, int, int], int],
) -> dict[tuple[int, int, int], int]:
    stored = np.unpackbits(tensors[name]).tolist()
    counts = tensors[name + ".counts"].tolist()
    places = [sum(counts[:number]) for number in range(10)]
    known: dict[tuple[int, int, int], int] = {}

    def bit(*voxel: int) -> int:
        return known.get((voxel[0], voxel[1], voxel[2]), 0)

    for x, y, z in order:
        score = (
            -6 + 2 * bit(x - 1, y, z) + 3 * bit(x, y - 1, z) + 3 * bit(x, y, z - 1)
            - 2 * bit(x - 2, y, z) + 2 * bit(x - 1, y + 1, z) + bit(x - 1, y, z + 1)
            + bit(x, y - 1, z + 1) + bit(x - 1, y + 1, z + 1) + bit(x - 1, y + 1, z - 1)
            + extra.get((x, y, z), 0)
        )  # fmt: skip
        number = min(abs(score), 9)
        known[x, y, z] = stored[places[number]] ^ (score > 0)
        places[number] += 1
    return known


@pytest.mark.parametrize("precision", PRECISIONS)
def test_another_program_reads_the_same(
    tmp_path: Path, region: StoredRegion, neighbour: StoredRegion, precision: str
) -> None:
    mask = ObservedMask.from_flags(neighbour.mask.flags.copy(), neighbour.mask.voxel_m)
    mask.flags[:20] = 0
    store = MapStore(tmp_path / "room.meslam")
    store.save([region, replace(neighbour, version=3, mask=mask)], GRID, precision=precision)
    ours, theirs = store.load().regions, read_map(store.path)
    for our, their in zip(ours, theirs, strict=True):
        flat = np.concatenate([values.reshape(-1) for values in ordered(their.weights)])
        assert np.array_equal(flat, our.parameters)
        assert np.array_equal(their.mask, our.mask.flags)
        assert their.metadata["version"] == our.version
    points = np.random.default_rng(0).uniform([-0.4, -1.6, -1.6], [2.8, 1.6, 1.6], (2000, 3))
    answer = NeuralMap(ours, backend="torch").values(points)
    total, mean, bits = np.zeros(len(points)), np.zeros((len(points), 4)), np.zeros(2000, int)
    for their in theirs:
        seen, f, color, distance = their.ask(points)
        weight = np.exp(-distance / (0.25 * their.metadata["side_m"] / 2)) * (seen & 1)
        total += weight
        mean += weight[:, None] * np.column_stack([f, color])
        bits |= seen
    known = total > 0
    assert 200 < known.sum() < 2000
    assert np.array_equal(bits, answer.flags)
    assert np.allclose((mean[known] / total[known, None])[:, 0], answer.distance[known], atol=1e-4)
    assert np.allclose((mean[known] / total[known, None])[:, 1:], answer.color[known], atol=1e-4)


def ordered(weights: dict[str, np.ndarray]) -> list[np.ndarray]:
    names = ["encoding.frequencies", "encoding.phases"]
    for layer in ("layer1", "layer2", "layer3", "layer4", "head"):
        names += [f"{layer}.weight", f"{layer}.bias"]
    assert set(names) == set(weights)
    return [weights[name] for name in names]
