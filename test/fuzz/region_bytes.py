"""Encoded regions and manifests taken apart, damaged inside and sealed again with right checksums.

Damage to the bytes themselves seldom gets past the checksum; an attacker computes it anew.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
from random import Random
from typing import Any

import zstandard
from fuzz.mutation import mutated_bytes, mutated_json, mutated_value

HEADER = struct.Struct("<8sIIQQ")
CHECKSUM_BYTES = 32


def content_of(data: bytes) -> bytes:
    """The safetensors content of encoded bytes; what cannot be read gives nothing."""
    try:
        return zstandard.ZstdDecompressor().decompress(
            data[HEADER.size + CHECKSUM_BYTES :], max_output_size=1 << 20
        )
    except zstandard.ZstdError:
        return b""


def sealed(content: bytes, payload: bytes | None = None, size: int | None = None) -> bytes:
    """An encoded region with any content, or with a payload and sizes that lie."""
    payload = zstandard.ZstdCompressor(level=1).compress(content) if payload is None else payload
    size = len(content) if size is None else size
    head = HEADER.pack(b"MESLAMRG", 1, 0, len(payload), size)
    return head + hashlib.sha256(head + payload).digest() + payload


def mutated_region(data: bytes, other: bytes, rng: Random) -> bytes:
    """A damaged region: outside, in its compression, its tensors' header, metadata or tensors."""
    content = content_of(data)
    kind = rng.randrange(10)
    if kind == 0 or len(content) < 8:
        return mutated_bytes(data, other, rng)
    if kind == 1:
        return _lying_compression(content, rng)
    if kind <= 3:
        return sealed(mutated_bytes(content, content_of(other), rng))
    length = int.from_bytes(content[:8], "little")
    try:
        header = json.loads(content[8 : 8 + length])
        metadata = header["__metadata__"]["meslam"].encode()
    except (ValueError, KeyError, TypeError, AttributeError):
        return mutated_bytes(data, other, rng)
    tensors = content[8 + length :]
    if kind <= 5:
        header = mutated_value(header, rng)
    elif kind <= 8:
        header["__metadata__"]["meslam"] = mutated_json(metadata, b"", rng).decode("latin-1")
    else:
        tensors = mutated_bytes(tensors, content_of(other)[8 + length :], rng)
    text = json.dumps(header).encode()
    return sealed(len(text).to_bytes(8, "little") + text + tensors)


def mutated_manifest(data: bytes, other: bytes, rng: Random) -> bytes:
    """A damaged manifest, most often with a right checksum."""
    return data if rng.random() < 0.1 else signed_manifest(mutated_json(data, other, rng))


def signed_manifest(data: bytes) -> bytes:
    """JSON as a manifest whose checksum is right."""
    try:
        document: Any = json.loads(data)
    except (ValueError, RecursionError):
        return data
    if not isinstance(document, dict):
        return data
    document.pop("sha256", None)
    document["sha256"] = "0" * 64
    text = json.dumps(document, indent=1).encode() + b"\n"
    digest = hashlib.sha256(text).hexdigest().encode()
    return re.sub(rb"0{64}(?=\"\n\}\n\Z)", digest, text)


def _lying_compression(content: bytes, rng: Random) -> bytes:
    """Bombs, sizes and windows that contradict each other, frames too many or too few."""
    kind = rng.randrange(6)
    frame = zstandard.ZstdCompressor(level=1).compress(content)
    if kind == 0:
        size = rng.choice((96 << 20, (96 << 20) + 1, 1 << 20))
        return sealed(b"", zstandard.ZstdCompressor(level=1).compress(bytes(size)), size)
    if kind == 1:
        return sealed(content, size=rng.choice((0, 1, len(content) - 1, 96 << 20, 2**64 - 1)))
    if kind == 2:
        compressor = zstandard.ZstdCompressor(write_content_size=False)
        return sealed(content, compressor.compress(content))
    if kind == 3:
        return sealed(content, frame + rng.choice((frame, b"\x50\x2a\x4d\x18\x04\0\0\0abcd")))
    if kind == 4:
        parameters = zstandard.ZstdCompressionParameters(window_log=rng.choice((10, 27, 31)))
        compressor = zstandard.ZstdCompressor(compression_params=parameters)
        return sealed(content, compressor.compress(content))
    return sealed(content, mutated_bytes(frame, b"", rng))
