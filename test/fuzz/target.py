"""What a fuzzer needs to know of a parser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz.mutation import Parts, mutated_parts


@dataclass(frozen=True)
class Target:
    """A parser under test.

    Attributes:
        name: of the target.
        what: is parsed, for the table.
        seeds: valid inputs, made by the product itself.
        run: parses an input, in an empty folder where it needs files. Refuses it with one of
            `refusals`, or returns a few words on what it took it for; what was accepted must be
            usable, so `run` uses it.
        mutate: makes an input out of another and the whole corpus.
        refusals: errors that say that an input is refused.
        seconds: of processor time that one input may take at most [s].
    """

    name: str
    what: str
    seeds: Callable[[], list[Parts]]
    run: Callable[[Parts, Path], str]
    mutate: Callable[[Parts, list[Parts], Random], Parts] = mutated_parts
    refusals: tuple[type[Exception], ...] = ()
    seconds: float = 5.0
