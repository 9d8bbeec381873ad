from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import data
import numpy as np
import pytest
import safetensors.numpy
import zstandard
from data.analytic_scene import SphereInRoom
from hypothesis import given, settings
from hypothesis import strategies as st

from meslam_core.errors import MapError
from meslam_core.field.network import parameter_shapes
from meslam_core.field.rendering import surface_level
from meslam_core.map import codec
from meslam_core.map.stored_region import StoredRegion

HEADER = struct.Struct("<8sIIQQ32s")
PRECISIONS = ("int8", "fp16", "fp32")


def content_of(data: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and metadata of encoded bytes, read with nothing of the package."""
    content = zstandard.ZstdDecompressor().decompress(data[HEADER.size :])
    length = int.from_bytes(content[:8], "little")
    metadata = json.loads(json.loads(content[8 : 8 + length])["__metadata__"]["meslam"])
    return safetensors.numpy.load(content), metadata


def sealed(payload: bytes, size: int, version: int = 1) -> bytes:
    """A payload with a header whose checksum is right."""
    head = HEADER.pack(b"MESLAMRG", version, 0, len(payload), size, b"")[:32]
    return head + hashlib.sha256(head + payload).digest() + payload


def forged(tensors: dict[str, np.ndarray], metadata: Any) -> bytes:
    """Encoded bytes with any content and a checksum that is right."""
    content = safetensors.numpy.save(tensors, {"meslam": json.dumps(metadata)})
    return sealed(zstandard.compress(content), len(content))


def assert_same_but_weights(decoded: StoredRegion, original: StoredRegion) -> None:
    assert decoded.index == original.index
    assert np.array_equal(decoded.T_map_region, original.T_map_region)
    assert decoded.side_m == original.side_m
    assert decoded.architecture == original.architecture
    assert np.array_equal(decoded.mask.flags, original.mask.flags)
    assert decoded.mask.voxel_m == original.mask.voxel_m
    assert decoded.mask.half_extent_m == original.mask.half_extent_m
    assert decoded.version == original.version
    assert decoded.stamp_ns == original.stamp_ns
    assert decoded.keyframes == original.keyframes


def test_fp32_is_exact(region: StoredRegion) -> None:
    decoded = codec.decode(codec.encode(region, "fp32"))
    assert np.array_equal(decoded.parameters, region.parameters)
    assert_same_but_weights(decoded, region)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_everything_but_the_weights_is_exact(small_region: StoredRegion, precision: str) -> None:
    assert_same_but_weights(codec.decode(codec.encode(small_region, precision)), small_region)


def test_bytes_written_once_mean_the_same_for_ever_and_everywhere() -> None:
    stored = Path(data.__path__[0], "region_v1.msr").read_bytes()
    region = codec.decode(stored)
    assert (region.index, region.version, region.keyframes) == ((1, -2, 3), 4, 9)
    weights = hashlib.sha256(region.parameters.astype("<f4").tobytes()).hexdigest()
    assert weights == "4d4b55a806876f2ff71753dbf955a6877b84d7a9f88ec4959d72b2e867345c34"
    mask = hashlib.sha256(region.mask.flags.tobytes()).hexdigest()
    assert mask == "a940b3dfe03cd4374ea1241e2eaaecc146bc55a364cfdf9e40e0726bdb4d8861"
    assert codec.precision_of(stored) == "int8"


def test_another_place_for_the_same_region(small_region: StoredRegion) -> None:
    for precision in PRECISIONS:
        there = codec.encode(small_region, precision)
        moved = codec.with_index(there, (7, 0, 0))
        assert codec.decode(moved).index == (7, 0, 0)
        assert codec.with_index(moved, small_region.index) == there


@pytest.mark.parametrize(("precision", "change_mm"), [("int8", 0.9), ("fp16", 0.05)])
def test_quantised_map_stays_close(
    region: StoredRegion, scene: SphereInRoom, precision: str, change_mm: float
) -> None:
    decoded = codec.decode(codec.encode(region, precision))
    points = scene.sample(20000, 0.1, np.random.default_rng(3))
    points = points[np.abs(scene.distance_m(points)) < 0.07]
    level = surface_level(region.architecture.field_config())
    unit = (points / region.half_side_m).astype(np.float32)
    before, after = (each.make_field("torch").predict(unit) for each in (region, decoded))
    truth = level - scene.distance_m(points) / 0.1
    moved_mm = np.abs(after[:, 0] - before[:, 0]).mean() * 100.0
    error_before, error_after = (np.abs(v[:, 0] - truth).mean() * 100.0 for v in (before, after))
    assert moved_mm < change_mm
    assert error_after < error_before + 0.15
    assert np.abs(after[:, 1:] - before[:, 1:]).mean() < 0.004


@pytest.mark.parametrize(
    ("precision", "weights_bytes"), [("int8", 25_400), ("fp16", 48_500), ("fp32", 95_800)]
)
def test_size(region: StoredRegion, precision: str, weights_bytes: int) -> None:
    mask_bytes = 800
    assert len(codec.encode(region, precision)) < weights_bytes + mask_bytes


@pytest.mark.parametrize("precision", PRECISIONS)
def test_encoding_a_decoded_region_gives_the_same_bytes(
    region: StoredRegion, precision: str
) -> None:
    data = codec.encode(region, precision)
    assert codec.encode(codec.decode(data), precision) == data


def test_weights_are_one_float32_product_as_the_format_says(region: StoredRegion) -> None:
    data = codec.encode(region, "int8")
    tensors, _ = content_of(data)
    parts = []
    for name, shape in parameter_shapes(64, 96).items():
        tensor = tensors[name]
        assert tensor.shape == shape
        if name + ".scale" in tensors:
            scale = tensors[name + ".scale"]
            rows = tensor.reshape(len(scale), -1).astype(np.float32)
            parts.append((rows * scale[:, None]).reshape(-1))
        else:
            parts.append(tensor.astype(np.float32).reshape(-1))
    assert np.array_equal(np.concatenate(parts), codec.decode(data).parameters)


def test_rows_of_zeros_tiny_rows_and_huge_rows(small_region: StoredRegion) -> None:
    parameters = small_region.parameters.copy()
    rows = parameters[32:160].reshape(16, 8)
    rows[0], rows[1], rows[2], rows[3] = 0.0, 1e-44, 1e-30, np.linspace(-3e6, 3e6, 8)
    data = codec.encode(replace(small_region, parameters=parameters))
    decoded = codec.decode(data)
    back = decoded.parameters[32:160].reshape(16, 8)
    assert np.array_equal(back[0], np.zeros(8))
    assert np.abs(back[1:3]).max() < 1e-6
    assert np.allclose(back[3], rows[3], atol=3e6 / 127)
    assert codec.encode(decoded) == data


def test_trained_rows_are_quantised_anew_and_others_kept(small_region: StoredRegion) -> None:
    first = codec.decode(codec.encode(small_region))
    trained = first.parameters.copy()
    trained[32] += np.float32(0.123)
    second = codec.decode(codec.encode(replace(first, parameters=trained)))
    assert np.array_equal(second.parameters[40:160], first.parameters[40:160])
    assert second.parameters[32] == pytest.approx(trained[32], abs=0.03)


def test_phases_may_have_grown_by_whole_turns(region: StoredRegion) -> None:
    parameters = region.parameters.copy()
    parameters[3 * 96 : 4 * 96] += np.float32(40 * np.pi)
    decoded = codec.decode(codec.encode(replace(region, parameters=parameters), "int8"))
    phases = decoded.parameters[3 * 96 : 4 * 96]
    turns = (phases - region.parameters[3 * 96 : 4 * 96]) / (2 * np.pi)
    assert np.abs(phases).max() < 3.15
    assert np.abs(turns - np.rint(turns)).max() < 1e-4


def test_nothing_observed(small_region: StoredRegion) -> None:
    small_region.mask.clear()
    assert not codec.decode(codec.encode(small_region)).mask.flags.any()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"parameters": np.full(1, 1.0, np.float32)}, "architecture"),
        ({"index": (2**40, 0, 0)}, "index"),
        ({"stamp_ns": -1}, "stamp_ns"),
        ({"T_map_region": np.diag([2.0, 1.0, 1.0, 1.0])}, "T_map_region"),
    ],
)
def test_impossible_regions_are_not_encoded(
    small_region: StoredRegion, change: dict[str, Any], named: str
) -> None:
    with pytest.raises(MapError, match=named):
        codec.encode(replace(small_region, **change))


def test_weights_that_are_not_finite_are_not_encoded(small_region: StoredRegion) -> None:
    small_region.parameters[5] = np.nan
    with pytest.raises(MapError, match="not finite"):
        codec.encode(small_region)


def test_weights_too_large_for_half_precision(small_region: StoredRegion) -> None:
    small_region.parameters[-10] = 1e6
    with pytest.raises(MapError, match="fp32"):
        codec.encode(small_region, "fp16")


def test_every_changed_byte_is_noticed(small_region: StoredRegion) -> None:
    data = codec.encode(small_region)
    for position in range(len(data)):
        for flip in (0xFF, 1 << (position % 8)):
            damaged = bytearray(data)
            damaged[position] ^= flip
            with pytest.raises(MapError, match=r"kitchen\.msr"):
                codec.decode(bytes(damaged), "kitchen.msr")


def test_every_truncation_and_anything_behind_is_noticed(small_region: StoredRegion) -> None:
    data = codec.encode(small_region)
    for length in range(len(data)):
        with pytest.raises(MapError, match="region"):
            codec.decode(data[:length])
    with pytest.raises(MapError, match="damaged"):
        codec.decode(data + b"\0")


def test_newer_version_is_told_from_damage(small_region: StoredRegion) -> None:
    payload = codec.encode(small_region)[HEADER.size :]
    with pytest.raises(MapError, match="newer MeSLAM"):
        codec.decode(sealed(payload, 1000, version=2))


@pytest.mark.parametrize("size", [1 << 40, codec.MAX_CONTENT_BYTES + 1])
def test_bombs_are_refused_before_memory_is_taken(size: int) -> None:
    # A frame header that announces `size` bytes, and no data: magic, descriptor, 8-byte size.
    frame = b"\x28\xb5\x2f\xfd" + bytes([0b11100000]) + struct.pack("<Q", size)
    for announced in (size, 1000):
        with pytest.raises(MapError, match=r"bytes of content|contradicts"):
            codec.decode(sealed(frame, announced))


def test_content_larger_than_announced() -> None:
    payload = zstandard.compress(bytes(1 << 20))
    with pytest.raises(MapError, match="contradicts"):
        codec.decode(sealed(payload, 1000))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 20))
    with pytest.raises(MapError, match="contradicts"):
        codec.decode(sealed(streamed, 1 << 20))


def test_data_behind_the_compressed_frame(small_region: StoredRegion) -> None:
    data = codec.encode(small_region)
    size = HEADER.unpack_from(data)[4]
    with pytest.raises(MapError, match="decompressed"):
        codec.decode(sealed(data[HEADER.size :] + b"more", size))


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("layer1.weight", None),
        ("layer1.weight", np.zeros((16, 9), np.int8)),
        ("layer1.weight", np.zeros((16, 8), np.uint8)),
        ("layer1.weight.scale", None),
        ("layer1.weight.scale", np.zeros(15, np.float32)),
        ("layer1.weight.scale", np.full(16, np.inf, np.float32)),
        ("layer1.bias", np.full(16, np.nan, np.float16)),
        ("layer1.bias", np.zeros(16, np.float64)),
        ("layer1.bias.scale", np.ones(16, np.float32)),
        ("mask.near", None),
        ("mask.observed", None),
        ("mask.observed", np.zeros(3, np.uint8)),
        ("mask.observed", np.zeros((2, 2), np.uint8)),
        ("mask.near", np.zeros(2, np.int8)),
        ("mask.near.counts", None),
        ("mask.near.counts", np.array([9, *[0] * 9], np.uint32)),
        ("mask.observed.counts", np.array([18, *[0] * 9], np.uint32)),
        ("mask.observed.counts", np.full(10, 2**32 - 1, np.uint32)),
        ("mask.observed.counts", np.zeros(10, np.int64)),
        ("extra", np.zeros(3, np.float32)),
    ],
)
def test_lying_tensors(small_region: StoredRegion, name: str, tensor: np.ndarray | None) -> None:
    tensors, metadata = content_of(codec.encode(small_region))
    tensors.pop(name, None)
    if tensor is not None:
        tensors[name] = tensor
    with pytest.raises(MapError, match="region"):
        codec.decode(forged(tensors, metadata))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("index", [0, 0]),
        ("index", [0, 0, 0.5]),
        ("index", "000"),
        ("T_map_region", [[1, 0, 0, 0]] * 4),
        ("T_map_region", [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ("side_m", 0),
        ("side_m", float("nan")),
        ("side_m", True),
        ("architecture.width", 100_000_000),
        ("architecture.embedding", -1),
        ("architecture.truncation_m", 0.0),
        ("architecture.density_scale", float("inf")),
        ("precision", "int4"),
        ("version", -1),
        ("stamp_ns", 2**63),
        ("keyframes", None),
        ("mask.voxel_m", 0.0),
        ("mask.count", 1_000_000),
        ("mask.count", 7),
        ("mask.corner", [7, 0, 0]),
        ("mask.corner", [-1, 0, 0]),
        ("mask.shape", [9, 1, 1]),
        ("mask.shape", [3, 3, 2]),
        ("mask.shape", [448, 448, 448]),
        ("mask.shape", [-1, 3, 1]),
        ("mask", []),
        ("architecture", None),
    ],
)
def test_lying_metadata(small_region: StoredRegion, path: str, value: Any) -> None:
    tensors, metadata = content_of(codec.encode(small_region))
    place = metadata
    *parents, last = path.split(".")
    for parent in parents:
        place = place[parent]
    place[last] = value
    with pytest.raises(MapError, match="region"):
        codec.decode(forged(tensors, metadata))
    del place[last]
    with pytest.raises(MapError, match="region"):
        codec.decode(forged(tensors, metadata))


@pytest.mark.parametrize("metadata", ["", 5, [], None, {"index": "[" * 100_000}])
def test_metadata_of_another_kind(small_region: StoredRegion, metadata: Any) -> None:
    tensors, _ = content_of(codec.encode(small_region))
    with pytest.raises(MapError, match="region"):
        codec.decode(forged(tensors, metadata))


def test_deeply_nested_metadata(small_region: StoredRegion) -> None:
    tensors, _ = content_of(codec.encode(small_region))
    content = safetensors.numpy.save(tensors, {"meslam": "[" * 200_000})
    with pytest.raises(MapError, match="metadata"):
        codec.decode(sealed(zstandard.compress(content), len(content)))


@given(data=st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_only_map_errors_for_any_bytes(data: bytes) -> None:
    for candidate in (data, sealed(data, len(data)), sealed(zstandard.compress(data), len(data))):
        with pytest.raises(MapError):
            codec.decode(candidate)


@given(edits=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1))
@settings(max_examples=300, deadline=None)
def test_only_map_errors_for_damaged_content_with_a_right_checksum(
    edits: list[tuple[int, int]], small_content: bytes
) -> None:
    content = bytearray(small_content)
    for position, value in edits:
        content[position % len(content)] = value
    try:
        decoded = codec.decode(sealed(zstandard.compress(bytes(content)), len(content)))
    except MapError:
        return
    assert np.isfinite(decoded.parameters).all()
    assert decoded.mask.flags.max(initial=0) <= 3


@pytest.fixture(scope="module")
def small_content() -> bytes:
    """What a small region's bytes hold once decompressed."""
    from meslam_core.config import FieldConfig
    from meslam_core.map.stored_region import Architecture
    from meslam_core.regions.observed_mask import ObservedMask

    architecture = Architecture.of(FieldConfig(width=16, embedding=8))
    weights = np.linspace(-1, 1, architecture.parameter_count, dtype=np.float32)
    mask = ObservedMask(0.4, 0.1)
    mask.flags[1:4, 1:4, 1:4] = 1
    region = StoredRegion((0, 0, 0), np.eye(4), 3.0, architecture, weights, mask, 1, 2, 3)
    return zstandard.decompress(codec.encode(region)[HEADER.size :])
