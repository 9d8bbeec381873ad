"""Damage to files, the same for the same seed."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

PAGE = 4096
Damage = Callable[[bytes, random.Random], bytes]


def truncated(data: bytes, generator: random.Random) -> bytes:
    """A part from the beginning."""
    return data[: generator.randrange(len(data))]


def flipped(data: bytes, generator: random.Random) -> bytes:
    """One to eight bits are others."""
    changed = bytearray(data)
    for _ in range(generator.choice((1, 2, 8))):
        changed[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
    return bytes(changed)


def flipped_early(data: bytes, generator: random.Random) -> bytes:
    """As `flipped`, among the first bytes, where formats keep their lengths."""
    return flipped(data[:512], generator) + data[512:]


def zeroed(data: bytes, generator: random.Random) -> bytes:
    """A page of zeros, as a disk leaves it."""
    start = generator.randrange(max(1, len(data) // PAGE)) * PAGE
    return data[:start] + b"\0" * len(data[start : start + PAGE]) + data[start + PAGE :]


def shuffled(data: bytes, generator: random.Random) -> bytes:
    """Two pages have changed places."""
    pages = [data[start : start + PAGE] for start in range(0, len(data), PAGE)]
    first, second = generator.randrange(len(pages)), generator.randrange(len(pages))
    pages[first], pages[second] = pages[second], pages[first]
    return b"".join(pages)


def garbled(data: bytes, generator: random.Random) -> bytes:
    """Text with a word, a line or a byte replaced, doubled or taken out."""
    lines = data.splitlines(keepends=True)
    number = generator.randrange(len(lines))
    kind = generator.randrange(5)
    if kind == 0:
        del lines[number]
    elif kind == 1:
        lines.insert(number, lines[generator.randrange(len(lines))])
    elif kind == 2:
        words = lines[number].split(b" ")
        words[generator.randrange(len(words))] = generator.choice(
            (b"nan", b"-1", b"1e400", b"\xff\xfe", b"", b"9" * 40, b"../../x", b"{", b"null")
        )
        lines[number] = b" ".join(words)
    else:
        return flipped(data, generator) if kind == 3 else truncated(data, generator)
    return b"".join(lines)


def damaged(file: Path, damage: Damage, seed: int) -> None:
    """Damage a file in place."""
    file.write_bytes(damage(file.read_bytes(), random.Random(seed)))
