"""A region to bytes and back; `docs/map-format.md` specifies them.

The same bytes are a file of the map store and the payload of a region message. They come from
disks and networks that damage them, so nothing in them is believed before it is checked, and
every size is checked before memory is taken for it.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import replace
from itertools import pairwise

import numpy as np
import safetensors
import safetensors.numpy
import zstandard
from numpy.typing import NDArray

from meslam_core.errors import MapError
from meslam_core.map.mask_code import CLASSES, CodedBits, decode_mask, encode_mask
from meslam_core.map.metadata import MAX_MASK_COUNT, PRECISIONS, Metadata
from meslam_core.map.stored_region import StoredRegion
from meslam_core.map.weights import Tensors, weights_from_tensors, weights_to_tensors
from meslam_core.regions.grid import RegionIndex
from meslam_core.regions.observed_mask import ObservedMask

FORMAT = "meslam-region/1"
FORMAT_VERSION = 1

MAX_FILE_BYTES = 64 << 20
MAX_CONTENT_BYTES = 96 << 20

_MAGIC = b"MESLAMRG"
_HEADER = struct.Struct("<8sIIQQ32s")
_CHECKED_HEADER_BYTES = _HEADER.size - 32
_LEVEL = 19
_LARGE = 1024
_METADATA_KEY = "meslam"
_PLANES = ("mask.observed", "mask.near")
_COUNTS = ".counts"


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
    metadata = Metadata.of(region, precision, corner, flags.shape)
    metadata.check(name)
    tensors = weights_to_tensors(region, precision, name)
    for plane, coded in zip(_PLANES, encode_mask(flags), strict=True):
        tensors |= {plane: coded.packed, plane + _COUNTS: coded.counts}
    return _sealed(safetensors.numpy.save(tensors, {_METADATA_KEY: metadata.to_json()}), name)


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
    parameters = weights_from_tensors(tensors, architecture, name)
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


def with_index(data: bytes, index: RegionIndex) -> bytes:
    """The same region, bit for bit, at another place on the lattice; raises as `decode`."""
    return encode(replace(decode(data), index=index), precision_of(data))


def _sealed(content: bytes, name: str) -> bytes:
    """Content compressed behind a header with its checksum."""
    if len(content) > MAX_CONTENT_BYTES:
        raise MapError(f"{name}: {len(content)} bytes are more than the format's maximum")
    packer = zstandard.ZstdCompressor(level=_LEVEL).compressobj(size=len(content))
    # Each large tensor is a block of its own, for its values are distributed in their own way.
    bounds = [0, *_large_tensors(content), len(content)]
    pieces = [
        packer.compress(content[start:end]) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        for start, end in pairwise(bounds)
    ]
    payload = b"".join(pieces) + packer.flush()
    head = _HEADER.pack(_MAGIC, FORMAT_VERSION, 0, len(payload), len(content), b"")
    head = head[:_CHECKED_HEADER_BYTES]
    return head + hashlib.sha256(head + payload).digest() + payload


def _large_tensors(content: bytes) -> list[int]:
    """Where the large tensors of a safetensors file begin."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    spans = [tensor["data_offsets"] for key, tensor in header.items() if key != "__metadata__"]
    return sorted(start + first for first, end in spans if end - first >= _LARGE)


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
    corner, shape, count = metadata.mask_corner, metadata.mask_shape, metadata.mask_count
    if any(low + size > count for low, size in zip(corner, shape, strict=True)):
        raise MapError(f"{name}: the observed mask does not fit its cube")
    planes = [_coded_bits(tensors, plane, name) for plane in _PLANES]
    whole = np.zeros((count, count, count), np.uint8)
    box = tuple(slice(low, low + size) for low, size in zip(corner, shape, strict=True))
    try:
        whole[box] = decode_mask(planes[0], planes[1], shape)
    except MapError as error:
        raise MapError(f"{name}: {error}") from error
    return ObservedMask.from_flags(whole, metadata.mask_voxel_m)


def _coded_bits(tensors: Tensors, plane: str, name: str) -> CodedBits:
    packed, counts = tensors.pop(plane, None), tensors.pop(plane + _COUNTS, None)
    if packed is None or packed.dtype != np.uint8 or packed.ndim != 1:
        raise MapError(f"{name}: tensor {plane!r} is missing or malformed")
    if counts is None or counts.dtype != np.uint32 or counts.shape != (CLASSES,):
        raise MapError(f"{name}: tensor {plane + _COUNTS!r} is missing or malformed")
    return CodedBits(counts, packed)
