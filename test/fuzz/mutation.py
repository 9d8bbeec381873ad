"""Damage to inputs: blind to bytes, and aware of text, numbers and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from copy import deepcopy
from random import Random
from typing import Any

Parts = dict[str, bytes]
"""An input: one or several named pieces, such as the files of a folder."""

MAX_PART_BYTES = 1 << 20

_EDGES = [0, 1, 2, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**30]
_EDGES += [2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1]
_NUMBER = re.compile(rb"-?[0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]+)?")
_ODD_NUMBERS = [
    *(str(value).encode() for value in _EDGES),
    *(b"-%d" % value for value in _EDGES),
    *(b"nan", b"NaN", b"inf", b"-Infinity", b"1e308", b"1e309", b"-1e400", b"1e-320", b"1e9999999"),
    *(b"", b"-", b".", b"0x10", b"1_0", b"1,5", b"\xd9\xa3", b"\xc2\xb2", b"9" * 400, b"9" * 5000),
]
_ODD_WORDS = [
    *(b"\0", b"\xff\xfe", b"\xed\xa0\x80", b"..", b"../..", b"/", b"/dev/zero", b"~", b"#", b"'"),
    *(
        b"{",
        b"[" * 3000,
        b"null",
        b"true",
        b"%s%n",
        b"A" * 5000,
        b"\r\n",
        b"\xe2\x80\xa8",
        b"&a *a",
    ),
]
_ODD_VALUES: list[Any] = [
    *(None, True, False, "", "\0", "..", "/dev/zero", "x" * 3000, "\ud800", [], {}, [[]], [None]),
    *(float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, -0.0, 0.5, 10**400),
    *_EDGES,
    *(-value for value in _EDGES),
]


def mutated_bytes(data: bytes, other: bytes, rng: Random) -> bytes:
    """Bytes with a few changes: flips, cuts, repetitions, edge values, a piece of another input."""
    result = bytearray(data)
    for _ in range(_changes(rng)):
        rng.choice(_BYTE_CHANGES)(result, other, rng)
    return bytes(result[:MAX_PART_BYTES])


def mutated_text(data: bytes, other: bytes, rng: Random) -> bytes:
    """Text with odd numbers, odd words, or lines that are missing, doubled or exchanged."""
    for _ in range(_changes(rng)):
        kind = rng.randrange(5)
        if kind == 0:
            data = mutated_bytes(data, other, rng)
        elif kind in (1, 2):
            found = list(_NUMBER.finditer(data))
            if found:
                start, end = rng.choice(found).span()
                data = data[:start] + rng.choice(_ODD_NUMBERS) + data[end:]
        elif kind == 3:
            place = rng.randint(0, len(data))
            data = data[:place] + rng.choice(_ODD_WORDS) + data[place:]
        else:
            lines = data.split(b"\n")
            source, target = rng.randrange(len(lines)), rng.randint(0, len(lines))
            lines.insert(target, lines[source])
            if rng.random() < 0.5:
                del lines[rng.randrange(len(lines))]
            data = b"\n".join(lines)
    return data[:MAX_PART_BYTES]


def mutated_json(data: bytes, other: bytes, rng: Random) -> bytes:
    """JSON that is still JSON, mostly: values of other types and sizes, members gone or new."""
    if rng.random() < 0.1:
        return mutated_text(data, other, rng)
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return mutated_text(data, other, rng)
    for _ in range(_changes(rng)):
        document = mutated_value(document, rng)
    return json.dumps(document).encode()


def mutated_value(document: Any, rng: Random) -> Any:
    """A tree of mappings and lists with one change somewhere."""
    places = list(_places(document))
    if not places:
        return deepcopy(rng.choice(_ODD_VALUES))
    container, key = rng.choice(places)
    kind = rng.randrange(5)
    if kind <= 1:
        container[key] = deepcopy(rng.choice(_ODD_VALUES))
    elif kind == 2 and isinstance(container[key], int | float):
        container[key] = _near(container[key], rng)
    elif kind == 3:
        source, name = rng.choice(places)
        container[key] = deepcopy(source[name])
    elif isinstance(container, dict):
        del container[key]
    elif rng.random() < 0.5:
        container.append(deepcopy(container[key]))
    else:
        del container[key]
    return document


def mutated_parts(
    parts: Parts,
    others: list[Parts],
    rng: Random,
    mutate: Callable[[bytes, bytes, Random], bytes] = mutated_bytes,
) -> Parts:
    """An input with one or two of its parts changed; `mutate` changes those that are binary."""
    result = dict(parts)
    for _ in range(rng.randint(1, 2)):
        name = rng.choice(sorted(result))
        other = rng.choice(others).get(name, result[name])
        result[name] = _mutation_for(name, mutate)(result[name], other, rng)
    return result


def _changes(rng: Random) -> int:
    """How many changes to make: mostly one, for most hide what comes after them."""
    return rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3, 4))


def _mutation_for(
    name: str, binary: Callable[[bytes, bytes, Random], bytes]
) -> Callable[[bytes, bytes, Random], bytes]:
    if name.endswith(".json"):
        return mutated_json
    return mutated_text if name.endswith((".txt", ".yaml")) else binary


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Container and key of every value in a tree."""
    found: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting:
        value = waiting.pop()
        keys = value if isinstance(value, dict) else range(len(value)) if _is_list(value) else ()
        for key in keys:
            found.append((value, key))
            waiting.append(value[key])
    return found


def _is_list(value: Any) -> bool:
    return isinstance(value, list)


def _near(value: float, rng: Random) -> float:
    changes: list[Callable[[], float]] = [
        lambda: value + 1,
        lambda: value - 1,
        lambda: -value,
        lambda: value * 2,
        lambda: value * 1000,
        lambda: value // 3 if isinstance(value, int) else value / 3,
    ]
    try:
        return rng.choice(changes)()
    except OverflowError:
        return 0


def _flip(data: bytearray, other: bytes, rng: Random) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _overwrite(data: bytearray, other: bytes, rng: Random) -> None:
    """A length or another number becomes an edge value, in either byte order."""
    size = rng.choice((1, 2, 4, 8))
    if len(data) >= size:
        place = rng.randrange(len(data) - size + 1)
        value = rng.choice(_EDGES) % (1 << 8 * size)
        data[place : place + size] = value.to_bytes(size, rng.choice(("little", "big")))  # type: ignore[arg-type]


def _nudge(data: bytearray, other: bytes, rng: Random) -> None:
    """A number changes by a little."""
    size = rng.choice((1, 2, 4, 8))
    if len(data) >= size:
        place = rng.randrange(len(data) - size + 1)
        value = int.from_bytes(data[place : place + size], "little") + rng.randint(-16, 16)
        data[place : place + size] = (value % (1 << 8 * size)).to_bytes(size, "little")


def _cut(data: bytearray, other: bytes, rng: Random) -> None:
    if data:
        del data[rng.randrange(len(data)) :]


def _remove(data: bytearray, other: bytes, rng: Random) -> None:
    start, end = _span(data, rng)
    del data[start:end]


def _repeat(data: bytearray, other: bytes, rng: Random) -> None:
    start, end = _span(data, rng)
    place = rng.randint(0, len(data))
    data[place:place] = bytes(data[start:end]) * rng.choice((1, 1, 2, 20))


def _fill(data: bytearray, other: bytes, rng: Random) -> None:
    start, end = _span(data, rng)
    data[start:end] = bytes([rng.choice((0, 255, rng.randrange(256)))]) * (end - start)


def _splice(data: bytearray, other: bytes, rng: Random) -> None:
    start, end = _span(data, rng)
    first, last = _span(other, rng)
    data[start:end] = other[first:last]


def _word(data: bytearray, other: bytes, rng: Random) -> None:
    place = rng.randint(0, len(data))
    data[place:place] = rng.choice(_ODD_WORDS + _ODD_NUMBERS)


def _span(data: bytes | bytearray, rng: Random) -> tuple[int, int]:
    """A piece, short more often than long."""
    start = rng.randint(0, len(data))
    length = min(int(2 ** rng.uniform(0, 12)), len(data) - start)
    return start, start + length


_BYTE_CHANGES = [
    *(_flip, _flip, _overwrite, _overwrite, _nudge, _cut, _remove, _repeat, _fill, _splice, _word)
]
