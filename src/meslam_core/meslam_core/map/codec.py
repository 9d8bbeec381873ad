"""A region to bytes and back; `docs/map-format.md` specifies them.

The same bytes are a file of the map store and the payload of a region message. They come from
disks and networks that damage them, so nothing in them is believed before it is checked, and
every size is checked before memory is taken for it.
"""

from __future__ import annotations

import hashlib
import json
import struct
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
import zstandard
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.field.network import parameter_shapes
from meslam_core.map.metadata import MAX_MASK_COUNT, PRECISIONS, Metadata
from meslam_core.map.stored_region import Architecture, StoredRegion
from meslam_core.regions.observed_mask import NEAR_SURFACE, OBSERVED, ObservedMask

FORMAT = "meslam-region/1"
FORMAT_VERSION = 1
PHASE_LIMIT = 3.1416  # a little above pi, so that quantised phases stay as they are

MAX_FILE_BYTES = 64 << 20
MAX_CONTENT_BYTES = 96 << 20

_MAGIC = b"MESLAMRG"
_HEADER = struct.Struct("<8sIIQQ32s")
_CHECKED_HEADER_BYTES = _HEADER.size - 32
_LEVEL = 19
_METADATA_KEY = "meslam"
_SCALE = ".scale"
_MASK = "mask"
_ENCODING = ("encoding.frequencies", "encoding.phases")

Tensors = dict[str, NDArray[Any]]


def encode(region: StoredRegion, precision: str = "int8") -> bytes:
    """A region as bytes.

    Args:
        region: to encode.
        precision: of the weights: 'int8' (a scale a row), 'fp16' or 'fp32' (exact).

    Raises:
        MapError: when the region holds values that the format cannot.
    """
    if precision not in PRECISIONS:
        raise MapError(f"weights cannot be stored as {precision!r}; use {', '.join(PRECISIONS)}")
    name = f"region {region.index}"
    count = region.mask.flags.shape[0]
    if count > MAX_MASK_COUNT:
        raise MapError(
            f"{name}: the observed mask has {count} voxels a side, at most {MAX_MASK_COUNT} can "
            "be stored; raise regions.mask_voxel_m or lower regions.mask_extent"
        )
    if len(region.parameters) != region.architecture.parameter_count:
        raise MapError(f"{name}: {len(region.parameters)} weights do not fit its architecture")
    if not np.isfinite(region.parameters).all():
        raise MapError(f"{name}: weights are not finite, so there is nothing to store")
    corner, flags = _cropped(region.mask.flags)
    tensors = _weights_to_tensors(region, precision, name)
    tensors[_MASK] = flags
    metadata = Metadata.of(region, precision, corner)
    metadata.check(name)
    content = safetensors.numpy.save(tensors, {_METADATA_KEY: metadata.to_json()})
    if len(content) > MAX_CONTENT_BYTES:
        raise MapError(f"{name}: {len(content)} bytes are more than the format's maximum")
    payload = zstandard.ZstdCompressor(level=_LEVEL).compress(content)
    head = _HEADER.pack(_MAGIC, FORMAT_VERSION, 0, len(payload), len(content), b"")
    head = head[:_CHECKED_HEADER_BYTES]
    return head + hashlib.sha256(head + payload).digest() + payload


def decode(data: bytes, name: str = "region") -> StoredRegion:
    """The region that `encode` made the bytes from.

    Args:
        data: of any origin.
        name: of their source, for messages.

    Raises:
        MapError: when the bytes are damaged, of another format or of a newer version.
    """
    content = _content(data, name)
    tensors, metadata = _parsed(content, name)
    architecture = metadata.architecture
    parameters = _weights_from_tensors(tensors, architecture, name)
    mask = _mask(tensors, metadata, name)
    if tensors:
        raise MapError(f"{name}: unexpected tensor {min(tensors)!r}; the content is damaged")
    return StoredRegion(
        index=metadata.index,
        T_map_region=np.array(metadata.T_map_region),
        side_m=metadata.side_m,
        architecture=architecture,
        parameters=parameters,
        mask=mask,
        version=metadata.version,
        stamp_ns=metadata.stamp_ns,
        keyframes=metadata.keyframes,
    )


def precision_of(data: bytes, name: str = "region") -> str:
    """How the weights in encoded bytes are stored; raises as `decode`."""
    return _parsed(_content(data, name), name)[1].precision


def _content(data: bytes, name: str) -> bytes:
    """The safetensors content of encoded bytes, once header, sizes and checksum agree."""
    if not _HEADER.size <= len(data) <= MAX_FILE_BYTES:
        raise MapError(f"{name}: {len(data)} bytes cannot be a region; it is truncated or foreign")
    magic, version, flags, packed, unpacked, digest = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise MapError(f"{name} is not an encoded region: it begins with {magic!r}")
    payload = memoryview(data)[_HEADER.size :]
    intact = hashlib.sha256(data[:_CHECKED_HEADER_BYTES] + payload).digest() == digest
    if version > FORMAT_VERSION and intact:
        raise MapError(
            f"{name} has format version {version}, this program reads up to {FORMAT_VERSION}; "
            "use a newer MeSLAM"
        )
    if packed != len(payload):
        raise MapError(
            f"{name}: the header announces {packed} bytes, there are {len(payload)}; "
            "it is truncated or damaged"
        )
    if not intact:
        raise MapError(f"{name}: the checksum does not match; it is damaged, restore a copy")
    if version != FORMAT_VERSION or flags:
        raise MapError(f"{name}: format version {version} with flags {flags} does not exist")
    return _decompressed(payload, unpacked, name)


def _decompressed(payload: memoryview, size: int, name: str) -> bytes:
    if size > MAX_CONTENT_BYTES:
        raise MapError(f"{name}: {size} bytes of content are more than {MAX_CONTENT_BYTES}")
    try:
        frame = zstandard.get_frame_parameters(payload)
        if frame.content_size != size or frame.window_size > MAX_CONTENT_BYTES:
            raise MapError(f"{name}: the compressed size contradicts the header; it is damaged")
        content = zstandard.ZstdDecompressor(max_window_size=MAX_CONTENT_BYTES).decompress(
            payload, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise MapError(f"{name}: cannot be decompressed ({error}); it is damaged") from error
    if len(content) != size:
        raise MapError(f"{name}: decompressed to {len(content)} bytes instead of {size}")
    return content


def _parsed(content: bytes, name: str) -> tuple[Tensors, Metadata]:
    """Tensors and metadata; safetensors itself checks that shapes and offsets fit the bytes."""
    try:
        tensors = safetensors.numpy.load(content)
        length = int.from_bytes(content[:8], "little")
        text = json.loads(content[8 : 8 + length])["__metadata__"][_METADATA_KEY]
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise MapError(f"{name}: the content is not a region's safetensors ({error!r})") from error
    return tensors, Metadata.from_json(text, name)


def _cropped(flags: NDArray[np.uint8]) -> tuple[tuple[int, int, int], NDArray[np.uint8]]:
    """Lowest corner and flags of the smallest box with everything observed."""
    corner, extent = [], []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        used = np.flatnonzero(flags.any(axis=others))
        corner.append(int(used[0]) if len(used) else 0)
        extent.append(int(used[-1]) + 1 - corner[-1] if len(used) else 0)
    box = tuple(slice(low, low + size) for low, size in zip(corner, extent, strict=True))
    return (corner[0], corner[1], corner[2]), np.ascontiguousarray(flags[box])


def _mask(tensors: Tensors, metadata: Metadata, name: str) -> ObservedMask:
    flags = tensors.pop(_MASK, np.zeros(0))
    corner, count = metadata.mask_corner, metadata.mask_count
    fits = flags.ndim == 3 and all(
        low + size <= count for low, size in zip(corner, flags.shape, strict=True)
    )
    if flags.dtype != np.uint8 or not fits:
        raise MapError(f"{name}: the observed mask is missing or does not fit its cube")
    if flags.size and flags.max() > OBSERVED | NEAR_SURFACE:
        raise MapError(f"{name}: the observed mask holds flags that do not exist")
    whole = np.zeros((count, count, count), np.uint8)
    box = tuple(slice(low, low + size) for low, size in zip(corner, flags.shape, strict=True))
    whole[box] = flags
    return ObservedMask.from_flags(whole, metadata.mask_voxel_m)


def _weights_to_tensors(region: StoredRegion, precision: str, name: str) -> Tensors:
    tensors: Tensors = {}
    start = 0
    shapes = parameter_shapes(region.architecture.width, region.architecture.embedding)
    for key, shape in shapes.items():
        size = int(np.prod(shape))
        values = region.parameters[start : start + size].reshape(shape).astype(np.float32)
        start += size
        if precision == "fp32":
            tensors[key] = values
        elif key in _ENCODING:
            if key == "encoding.phases":
                turned = np.remainder(values.astype(np.float64) + np.pi, 2 * np.pi) - np.pi
                values = np.where(np.abs(values) > PHASE_LIMIT, turned, values).astype(np.float32)
            tensors |= _quantized(key, values.reshape(1, -1), np.int16, shape)
        elif precision == "int8" and len(shape) == 2:
            tensors |= _quantized(key, values, np.int8, shape)
        else:
            with np.errstate(over="ignore"):
                tensors[key] = values.astype(np.float16)
            if not np.isfinite(tensors[key]).all():
                raise MapError(f"{name}: weights are too large for {precision}; store fp32")
    return tensors


def _quantized(key: str, rows: NDArray[np.float32], kind: type, shape: tuple[int, ...]) -> Tensors:
    """Integers and a float32 scale a row.

    Scales are rounded up to few bits of mantissa (16 for int8, a power of two for int16), so
    that integer times scale is exact in float32 and encoding a decoded region again gives the
    same bytes.
    """
    limit = float(np.iinfo(kind).max)
    mantissa, exponent = np.frexp(np.abs(rows).max(axis=1).astype(np.float64) / limit)
    steps = 2.0**16 if kind is np.int8 else 1.0
    scale = np.ldexp(np.ceil(mantissa * steps) / steps, exponent).astype(np.float32)
    divisor = np.where(scale > 0, scale, np.float32(1)).astype(np.float64)
    integers: NDArray[Any] = np.clip(np.rint(rows / divisor[:, None]), -limit, limit).astype(kind)
    return {key: integers.reshape(shape), key + _SCALE: scale}


def _weights_from_tensors(
    tensors: Tensors, architecture: Architecture, name: str
) -> NDArray[np.float32]:
    """The flat vector; one float32 product a weight, so that every machine gets the same bits."""
    parts = []
    for key, shape in parameter_shapes(architecture.width, architecture.embedding).items():
        stored, scale = tensors.pop(key, None), tensors.pop(key + _SCALE, None)
        if stored is None or stored.shape != shape:
            raise MapError(f"{name}: tensor {key!r} is missing or not of shape {shape}")
        values = stored.astype(np.float32)
        if stored.dtype in (np.int8, np.int16):
            rows = values.reshape(1 if key in _ENCODING else shape[0], -1)
            if scale is None or scale.dtype != np.float32 or scale.shape != (len(rows),):
                raise MapError(f"{name}: tensor {key + _SCALE!r} is missing or malformed")
            with np.errstate(invalid="ignore", over="ignore"):  # checked below
                values = rows * scale[:, None]
        elif stored.dtype not in (np.float16, np.float32) or scale is not None:
            raise MapError(f"{name}: tensor {key!r} has an unknown type {stored.dtype}")
        parts.append(values.reshape(-1))
    parameters = np.concatenate(parts)
    if not np.isfinite(parameters).all():
        raise MapError(f"{name}: weights are not finite; the content is damaged")
    return parameters
